"""Flags of collection."""

from __future__ import annotations

from dataclasses import dataclass

from lerobot.envs import EnvConfig

from lerobot_agpd.guidance.config import require

STRATEGIES = ("guided", "replay")

EVALUATION_SEEDS = (100_000, 1_000_000)
"""Environment seeds left to final evaluations; LeRobot's own evaluation during training counts up from --seed."""

COLLECTION_SEEDS = (1_000_000, 2**31 - 1)
"""Environment seeds that collection draws from."""


@dataclass
class CollectConfig:
    """When, where and how new episodes are collected (stage 1)."""

    env: EnvConfig | None = None  # environment to collect in; default: the run's --env.*
    strategy: str = "guided"  # guided: teacher guided toward the student (AGPD); replay: teacher alone (PD)
    warmup: int = 1000  # training steps on the demonstrations before the first round
    every: int = 1000  # training steps between rounds; 0: never collect
    rounds: int | None = None  # number of rounds; default: until training ends
    episodes: int = 50  # episodes generated per round, over all processes
    n_envs: int = 16  # environments stepped side by side in every process
    use_async_envs: bool = False  # step them in worker processes: worth it for slow rendering and many cores
    unguided_fraction: float = (
        0.2  # share of a guided round that runs without guidance, to know the teacher's own rate
    )
    min_reward: float | None = (
        None  # keep episodes whose largest reward reaches this; default: the environment's is_success
    )
    min_length: int = (
        2  # drop episodes with fewer steps; those that pass at their first step are dropped anyway
    )
    n_action_steps: int | None = (
        None  # steps executed per decision; default: the smaller of the teacher's and the student's
    )
    push_to_hub: bool = False  # upload the merged episodes as a dataset when training ends
    repo_id: str | None = None  # Hub repository of the merged episodes; required to upload

    def __post_init__(self) -> None:
        require(
            self.strategy in STRATEGIES,
            f"--policy.collect.strategy must be one of {list(STRATEGIES)}, got '{self.strategy}'",
        )
        require(self.every >= 0, f"--policy.collect.every must not be negative, got {self.every}")
        require(self.warmup >= 1, f"--policy.collect.warmup must be at least 1, got {self.warmup}")
        for name in ("episodes", "n_envs", "min_length"):
            require(
                getattr(self, name) >= 1,
                f"--policy.collect.{name} must be at least 1, got {getattr(self, name)}",
            )
        require(
            self.rounds is None or self.rounds >= 0,
            f"--policy.collect.rounds must not be negative, got {self.rounds}",
        )
        require(
            0 <= self.unguided_fraction <= 1,
            f"--policy.collect.unguided_fraction must be in [0, 1], got {self.unguided_fraction}",
        )
        require(
            self.n_action_steps is None or self.n_action_steps >= 1,
            f"--policy.collect.n_action_steps must be at least 1, got {self.n_action_steps}",
        )
        require(
            not self.push_to_hub or bool(self.repo_id),
            "--policy.collect.push_to_hub=true needs --policy.collect.repo_id",
        )

    @property
    def enabled(self) -> bool:
        """Whether any round will be collected."""
        return self.every > 0 and self.rounds != 0
