"""Flags of collection."""

from __future__ import annotations

from dataclasses import dataclass, field

from lerobot.envs import EnvConfig

from lerobot_agpd.guidance.config import require

STRATEGIES = ("guided", "replay", "mixing", "rollin")
MIXING_FORMS = ("interpolate", "switch")
MIXING_SCHEDULES = ("constant", "linear", "exponential")

EVALUATION_SEEDS = (100_000, 1_000_000)
"""Environment seeds left to final evaluations; LeRobot's own evaluation during training counts up from --seed."""

COLLECTION_SEEDS = (1_000_000, 2**31 - 1)
"""Environment seeds that collection draws from."""


@dataclass
class MixingConfig:
    """strategy=mixing: how teacher and student share the actions (DAgger, arXiv:1011.0686; Eq. 6-7)."""

    form: str = (
        "interpolate"  # interpolate: between both chunks (Eq. 6); switch: one of them at random (Eq. 7)
    )
    weight: float = 0.3  # lambda, the student's share of the actions, once the schedule has reached it
    schedule: str = "constant"  # over the rounds: constant, linear (0 at first) or exponential (DAgger's own)
    rounds: int = 5  # linear: rounds until the weight is reached
    decay: float = 0.5  # exponential: factor by which every round shrinks what the weight still lacks
    relabel: bool = False  # record the teacher's action instead of the executed one (as DAgger does)

    def __post_init__(self) -> None:
        require(
            self.form in MIXING_FORMS,
            f"--policy.collect.mixing.form must be one of {list(MIXING_FORMS)}, got '{self.form}'",
        )
        require(
            self.schedule in MIXING_SCHEDULES,
            f"--policy.collect.mixing.schedule must be one of {list(MIXING_SCHEDULES)}, got '{self.schedule}'",
        )
        require(0 <= self.weight <= 1, f"--policy.collect.mixing.weight must be in [0, 1], got {self.weight}")
        require(self.rounds >= 1, f"--policy.collect.mixing.rounds must be at least 1, got {self.rounds}")
        require(0 <= self.decay < 1, f"--policy.collect.mixing.decay must be in [0, 1), got {self.decay}")

    def weight_at(self, number: int) -> float:
        """Lambda of round `number`, counted from 0.

        With weight 1 the exponential schedule is DAgger's beta_i = decay^i, since lambda = 1 - beta.
        """
        if self.schedule == "linear":
            return self.weight * min(1.0, number / self.rounds)
        if self.schedule == "exponential":
            return self.weight * (1 - self.decay**number)
        return self.weight


@dataclass
class RollinConfig:
    """strategy=rollin: the student begins every episode, the teacher finishes it."""

    max_fraction: float = 0.5  # the student's part is drawn up to this share of the longest possible episode
    episode_steps: int | None = None  # steps of the longest episode; default: the environment's own limit
    record_student: bool = False  # record the student's part too: its mistakes are then imitated

    def __post_init__(self) -> None:
        require(
            0 < self.max_fraction <= 1,
            f"--policy.collect.rollin.max_fraction must be in (0, 1], got {self.max_fraction}",
        )
        require(
            self.episode_steps is None or self.episode_steps >= 1,
            f"--policy.collect.rollin.episode_steps must be at least 1, got {self.episode_steps}",
        )


@dataclass
class VariationConfig:
    """Where and how strongly to guide, beyond the paper; for the strategies guided and rollin."""

    quantile: float = (
        0.0  # guide only where J of the unguided chunk exceeds this quantile of the round; 0: always
    )
    scale_spread: float = (
        1.0  # an episode's scale is drawn from [scale / spread, scale * spread]; 1: not at all
    )

    def __post_init__(self) -> None:
        require(
            0 <= self.quantile < 1,
            f"--policy.collect.variation.quantile must be in [0, 1), got {self.quantile}",
        )
        require(
            self.scale_spread >= 1,
            f"--policy.collect.variation.scale_spread must be at least 1, got {self.scale_spread}",
        )

    @property
    def active(self) -> bool:
        """Whether it changes anything."""
        return self.quantile > 0 or self.scale_spread > 1


@dataclass
class DiagnosticsConfig:
    """What is measured of every round beside success; it never changes the episodes."""

    observations: int = 32  # decisions at which teacher and strategy are sampled again; 0: no diagnostics
    samples: int = 16  # samples of both at each of them
    states: int = 2000  # visited states, at most, whose diversity is measured
    neighbours: int = 3  # k of the nearest-neighbour entropy
    epsilon: float = (
        0.5  # a state is covered if a recorded one is as near, in standard deviations per dimension
    )

    def __post_init__(self) -> None:
        for name, least in (("observations", 0), ("samples", 2), ("neighbours", 1)):
            require(
                getattr(self, name) >= least,
                f"--policy.collect.diagnostics.{name} must be at least {least}, got {getattr(self, name)}",
            )
        require(
            self.states > self.neighbours,
            f"--policy.collect.diagnostics.states must exceed neighbours={self.neighbours}, got {self.states}",
        )
        require(
            self.epsilon > 0,
            f"--policy.collect.diagnostics.epsilon must be positive, got {self.epsilon}",
        )


@dataclass
class CollectConfig:
    """When, where and how new episodes are collected (stage 1)."""

    env: EnvConfig | None = None  # environment to collect in; default: the run's --env.*
    strategy: str = "guided"  # guided (AGPD), replay (PD), mixing (DAgger) or rollin (the student begins)
    mixing: MixingConfig = field(default_factory=MixingConfig)  # strategy=mixing
    rollin: RollinConfig = field(default_factory=RollinConfig)  # strategy=rollin
    variation: VariationConfig = field(default_factory=VariationConfig)  # of guided and rollin
    diagnostics: DiagnosticsConfig = field(default_factory=DiagnosticsConfig)  # of every round
    warmup: int = 1000  # training steps on the demonstrations before the first round
    every: int = 1000  # training steps between rounds; 0: never collect
    rounds: int | None = None  # number of rounds; default: until training ends
    episodes: int = 50  # episodes generated per round, over all processes
    n_envs: int = 16  # environments stepped side by side in every process
    use_async_envs: bool = False  # step them in worker processes: worth it for slow rendering and many cores
    unguided_fraction: float = (
        0.2  # share of a round without guidance or mixing, to know the teacher's own rate
    )
    retry_fraction: float = (
        0.0  # share of a round, at most, that starts again where the earlier rounds' episodes have failed
    )
    min_reward: float | None = (
        None  # keep episodes whose largest reward reaches this; default: the environment's is_success
    )
    min_length: int = (
        2  # drop episodes with fewer steps; those that pass at their first step are dropped anyway
    )
    keep_failures: bool = (
        False  # keep episodes that fail too, for imitation of the teacher's own chunks (replay.relabel=all)
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
        require(
            not self.variation.active or self.guides,
            f"--policy.collect.variation.* acts on guidance, and strategy={self.strategy} does not guide; leave it "
            "out, or pass --policy.collect.strategy=guided or rollin",
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
        for name in ("unguided_fraction", "retry_fraction"):
            require(
                0 <= getattr(self, name) <= 1,
                f"--policy.collect.{name} must be in [0, 1], got {getattr(self, name)}",
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

    @property
    def guides(self) -> bool:
        """Whether the teacher is guided, and its scale adapted from round to round."""
        return self.strategy in ("guided", "rollin")
