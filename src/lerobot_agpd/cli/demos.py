"""`lerobot-agpd-demos`: successful episodes of a scripted expert as a LeRobotDataset."""

import json
import logging
import shutil
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import draccus
import gymnasium as gym
import numpy as np
from datasets import disable_progress_bars
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import ACTION, DONE, OBS_ENV_STATE, OBS_STATE, REWARD
from lerobot.utils.utils import init_logging
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from lerobot_agpd.collect.config import EVALUATION_SEEDS
from lerobot_agpd.envs.experts import Expert, make_expert
from lerobot_agpd.envs.gymnasium_robotics import AGENT_POS, ENVIRONMENT_STATE, GymnasiumRoboticsEnv

logger = logging.getLogger(__name__)

# Attempts per wanted episode after which the expert is held to be broken.
MAX_ATTEMPTS_PER_EPISODE = 10
SUCCESS = "next.success"
REPORT_PATH = Path("meta/demos.json")

Frame = dict[str, Any]


@dataclass
class DemosConfig:
    """Options of `lerobot-agpd-demos`."""

    root: Path  # folder of the new dataset; must not exist
    env: EnvConfig = field(
        default_factory=GymnasiumRoboticsEnv
    )  # environment; its task needs a scripted expert
    repo_id: str = "local/demos"  # name of the new dataset
    episodes: int = 50  # successful episodes to record
    seed: int = 0  # attempt i starts from environment seed `seed + i`
    push_to_hub: bool = False  # upload the dataset when it is done

    def __post_init__(self) -> None:
        """Check the options.

        Raises:
            ValueError: if the environment is of another type, no episode is wanted or the seeds reach those of
                evaluations.
            FileExistsError: if `root` exists.
        """
        if not isinstance(self.env, GymnasiumRoboticsEnv):
            raise ValueError(f"--env.type={self.env.type} has no scripted experts; use gymnasium_robotics.")
        if self.episodes < 1:
            raise ValueError(f"--episodes must be at least 1, got {self.episodes}.")
        if self.seed < 0 or self.seed + self.episodes > EVALUATION_SEEDS[0]:
            raise ValueError(
                f"--seed={self.seed} with --episodes={self.episodes}: the seeds of demonstrations lie in "
                f"[0, {EVALUATION_SEEDS[0]}); evaluations use those from {EVALUATION_SEEDS[0]} on."
            )
        if self.root.exists():
            raise FileExistsError(f"--root={self.root} already exists; choose a new folder.")


@dataclass
class DemosReport:
    """What happened to the attempts; written to `meta/demos.json` in the dataset.

    Attributes:
        task: the environment's task.
        seeds: environment seed of every recorded episode, in order.
        trivial_seeds: seeds skipped because the goal was reached before the first step.
        failed_seeds: seeds whose goal was not reached at the last step.
        frames: recorded frames.
    """

    task: str
    seeds: list[int] = field(default_factory=list)
    trivial_seeds: list[int] = field(default_factory=list)
    failed_seeds: list[int] = field(default_factory=list)
    frames: int = 0

    @property
    def attempts(self) -> int:
        """Episodes begun, those with a trivial start included."""
        return len(self.seeds) + len(self.trivial_seeds) + len(self.failed_seeds)

    @property
    def success_rate(self) -> float:
        """Share of episodes with the goal reached at the last step, without trivial starts; nan if there are none."""
        played = len(self.seeds) + len(self.failed_seeds)
        return len(self.seeds) / played if played else float("nan")

    def to_table(self) -> Table:
        """Lay the counts out for the console."""
        table = Table("scripted expert", self.task)
        table.add_row("attempts", str(self.attempts))
        table.add_row("skipped: goal reached at the start", str(len(self.trivial_seeds)))
        table.add_row("dropped: failed", str(len(self.failed_seeds)))
        table.add_row("recorded episodes", str(len(self.seeds)))
        table.add_row("recorded frames", str(self.frames))
        table.add_row("success rate without trivial starts", f"{self.success_rate:.3f}")
        return table


def dataset_features(env_config: EnvConfig) -> dict[str, dict[str, Any]]:
    """Features of a recorded frame: the environment's, reward, success and end of the episode."""
    features: dict[str, dict[str, Any]] = {
        env_config.features_map[key]: {"dtype": "float32", "shape": tuple(feature.shape), "names": None}
        for key, feature in env_config.features.items()
    }
    features[REWARD] = {"dtype": "float32", "shape": (1,), "names": None}
    features[SUCCESS] = {"dtype": "bool", "shape": (1,), "names": None}
    features[DONE] = {"dtype": "bool", "shape": (1,), "names": None}
    return features


def play_episode(env: gym.Env, expert: Expert, seed: int) -> list[Frame] | None:
    """Let the expert play one episode to its end.

    Args:
        env: a single environment with LeRobot's raw keys.
        expert: maps a raw observation to an action.
        seed: environment seed of the reset.

    Returns:
        One dataset frame per step, or None if the goal is reached before the first step.
    """
    observation, info = env.reset(seed=seed)
    if info["is_success"]:
        return None
    frames: list[Frame] = []
    done = False
    while not done:
        action = expert(observation)
        frame = {
            OBS_STATE: observation[AGENT_POS],
            OBS_ENV_STATE: observation[ENVIRONMENT_STATE],
            ACTION: action,
        }
        observation, reward, terminated, truncated, info = env.step(action)
        done = terminated or truncated
        frame[REWARD] = np.array([reward], dtype=np.float32)
        frame[SUCCESS] = np.array([info["is_success"]], dtype=bool)
        frame[DONE] = np.array([done], dtype=bool)
        frames.append(frame)
    return frames


def successful_episodes(
    env: gym.Env, expert: Expert, config: DemosConfig, report: DemosReport
) -> Iterator[list[Frame]]:
    """Play seed after seed and yield episodes whose goal is reached at the last step, `config.episodes` of them.

    `report` is brought up to date on the way.

    Raises:
        RuntimeError: if the seeds reach those of evaluations, or after `MAX_ATTEMPTS_PER_EPISODE` attempts per wanted
            episode.
    """
    while len(report.seeds) < config.episodes:
        seed = config.seed + report.attempts
        if seed >= EVALUATION_SEEDS[0] or report.attempts >= MAX_ATTEMPTS_PER_EPISODE * config.episodes:
            raise RuntimeError(
                f"Only {len(report.seeds)} of {config.episodes} episodes succeeded in {report.attempts} attempts "
                f"({len(report.trivial_seeds)} trivial, {len(report.failed_seeds)} failed); next seed {seed}."
            )
        frames = play_episode(env, expert, seed)
        if frames is None:
            report.trivial_seeds.append(seed)
        elif not frames[-1][SUCCESS].item():
            report.failed_seeds.append(seed)
        else:
            report.seeds.append(seed)
            report.frames += len(frames)
            yield frames


def new_partial_root(root: Path) -> Path:
    """Return `<root>.partial`, where the dataset grows; what an interrupted run left there is removed."""
    partial = root.with_name(root.name + ".partial")
    if partial.exists():
        logger.warning("Removing %s, left by an interrupted run (such a dataset is unreadable).", partial)
        shutil.rmtree(partial)
    return partial


def record_demos(config: DemosConfig) -> DemosReport:
    """Record the dataset in `<root>.partial` and rename it when it is complete.

    Raises:
        ValueError: if the task has no expert.
        RuntimeError: if too few episodes succeed.
        ModuleNotFoundError: if Gymnasium-Robotics is not installed.
    """
    assert isinstance(config.env, GymnasiumRoboticsEnv)
    expert = make_expert(config.env.gym_id)
    report = DemosReport(task=config.env.gym_id)
    env = config.env.make_single()
    try:
        partial = new_partial_root(config.root)
        dataset = LeRobotDataset.create(
            config.repo_id,
            fps=config.env.fps,
            features=dataset_features(config.env),
            root=partial,
            use_videos=False,
        )
        task_description = env.get_wrapper_attr("task_description")
        with _progress() as progress:
            bar = progress.add_task(report.task, total=config.episodes)
            for frames in successful_episodes(env, expert, config, report):
                for frame in frames:
                    dataset.add_frame({**frame, "task": task_description})
                dataset.save_episode()
                progress.advance(bar)
        dataset.finalize()
    finally:
        env.close()
    (partial / REPORT_PATH).write_text(json.dumps(asdict(report), indent=2) + "\n")
    partial.rename(config.root)
    return report


def _progress() -> Progress:
    return Progress(
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    )


@draccus.wrap()
def run(config: DemosConfig) -> None:
    """Record, report and optionally upload."""
    report = record_demos(config)
    Console().print(report.to_table())
    dataset = LeRobotDataset(config.repo_id, root=config.root)
    logger.info("%d episodes, %d frames in %s", dataset.num_episodes, dataset.num_frames, config.root)
    if config.push_to_hub:
        dataset.push_to_hub()


def main() -> None:
    """Console entry point."""
    init_logging()
    disable_progress_bars()  # one bar of the datasets library per episode would tear ours apart
    run()


if __name__ == "__main__":
    main()
