"""`lerobot-agpd-demos`: successful episodes of a scripted expert as a LeRobotDataset.

With `--skill` below 1 the expert is played by an operator who hesitates, trembles, takes detours and makes mistakes
(`envs.operators`); a list of skills makes a mixture of operators. The dataset then has the feature `skill`, which no
policy reads, and `meta/demos.json` the skill of every episode.
"""

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
from lerobot.configs import FeatureType
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import DONE, REWARD, SUCCESS
from rich.console import Console

from lerobot_agpd.cli.command import command
from lerobot_agpd.cli.progress import episode_bar
from lerobot_agpd.collect.config import EVALUATION_SEEDS
from lerobot_agpd.envs.base import SingleEnvConfig
from lerobot_agpd.envs.demonstrations import DemosReport, Frame, play_episode
from lerobot_agpd.envs.experts import make_expert
from lerobot_agpd.envs.experts.base import Expert
from lerobot_agpd.envs.gymnasium_robotics import GymnasiumRoboticsEnv
from lerobot_agpd.envs.operators import Operator

logger = logging.getLogger(__name__)

# Attempts per wanted episode after which the expert is held to be broken.
MAX_ATTEMPTS_PER_EPISODE = 10
SKILL = "skill"
REPORT_PATH = Path("meta/demos.json")


@dataclass
class DemosConfig:
    """Options of `lerobot-agpd-demos`."""

    root: Path  # folder of the new dataset; must not exist
    env: EnvConfig = field(default_factory=GymnasiumRoboticsEnv)  # its task needs a scripted expert
    repo_id: str = "local/demos"  # name of the new dataset
    episodes: int = 50  # successful episodes to record
    seed: int = 0  # attempt i starts from environment seed `seed + i`
    skill: float | list[float] = 1.0  # 1 is the expert, 0 the worst operator; "[1,0.5]": in turn
    push_to_hub: bool = False  # upload the dataset when it is done

    def __post_init__(self) -> None:
        """Check the options.

        Raises:
            ValueError: if the task has no expert, no episode is wanted or the seeds reach those of
                evaluations.
            FileExistsError: if `root` exists.
        """
        make_expert(self.env)
        if not self.skills or not all(0 <= skill <= 1 for skill in self.skills):
            raise ValueError(f"--skill={self.skill} must be one or several numbers in [0, 1].")
        if self.episodes < 1:
            raise ValueError(f"--episodes must be at least 1, got {self.episodes}.")
        if self.seed < 0 or self.seed + self.episodes > EVALUATION_SEEDS[0]:
            raise ValueError(
                f"--seed={self.seed} with --episodes={self.episodes}: the seeds of demonstrations lie in "
                f"[0, {EVALUATION_SEEDS[0]}); evaluations use those from {EVALUATION_SEEDS[0]} on."
            )
        if self.root.exists():
            raise FileExistsError(f"--root={self.root} already exists; choose a new folder.")

    @property
    def skills(self) -> list[float]:
        """One skill per operator."""
        return self.skill if isinstance(self.skill, list) else [self.skill]

    @property
    def is_expert(self) -> bool:
        """Whether the expert itself plays alone."""
        return self.skills == [1.0]


def dataset_features(config: DemosConfig) -> dict[str, dict[str, Any]]:
    """Features of a recorded frame: the environment's, reward, success, end of the episode and perhaps the skill."""
    features: dict[str, dict[str, Any]] = {}
    for key, feature in config.env.features.items():
        is_image = feature.type is FeatureType.VISUAL
        features[config.env.features_map[key]] = {
            "dtype": "image" if is_image else "float32",
            "shape": tuple(feature.shape),
            "names": ["height", "width", "channel"] if is_image else None,
        }
    features[REWARD] = {"dtype": "float32", "shape": (1,), "names": None}
    features[SUCCESS] = {"dtype": "bool", "shape": (1,), "names": None}
    features[DONE] = {"dtype": "bool", "shape": (1,), "names": None}
    if not config.is_expert:
        features[SKILL] = {"dtype": "float32", "shape": (1,), "names": None}
    return features


def successful_episodes(
    env: gym.Env, expert: Expert, config: DemosConfig, report: DemosReport
) -> Iterator[list[Frame]]:
    """Play seed after seed and yield episodes whose goal is reached at the last step, `config.episodes` of them.

    Operators take turns: the one whose turn it is plays until an episode succeeds. Their noise follows from
    `config.seed` and the seed of the episode. `report` is brought up to date on the way.

    Raises:
        RuntimeError: if the seeds reach those of evaluations, or after `MAX_ATTEMPTS_PER_EPISODE` attempts per wanted
            episode.
    """
    while len(report.seeds) < config.episodes:
        seed = config.seed + report.attempts
        if seed >= EVALUATION_SEEDS[0] or report.attempts >= MAX_ATTEMPTS_PER_EPISODE * config.episodes:
            raise RuntimeError(
                f"Only {len(report.seeds)} of {config.episodes} episodes succeeded in {report.attempts} attempts "
                f"({len(report.trivial_seeds)} trivial, {len(report.failed_seeds)} failed); next seed {seed}. "
                "A less skilled operator needs a larger --env.episode_length."
            )
        skill = config.skills[len(report.seeds) % len(config.skills)]
        operator = Operator(expert, skill, np.random.default_rng([config.seed, seed]))
        frames = play_episode(env, operator, seed, config.env.features_map)
        if frames is None:
            report.trivial_seeds.append(seed)
        elif not frames[-1][SUCCESS].item():
            report.failed_seeds.append(seed)
            report.failed_skills.append(skill)
        else:
            report.seeds.append(seed)
            report.skills.append(skill)
            report.frames += len(frames)
            if not config.is_expert:
                frames = [{**frame, SKILL: np.array([skill], dtype=np.float32)} for frame in frames]
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
        ModuleNotFoundError: if the package of the environment is not installed.
    """
    assert isinstance(config.env, SingleEnvConfig)  # all those with experts are
    expert = make_expert(config.env)
    report = DemosReport(task=str(config.env.task))
    env = config.env.make_single()
    try:
        partial = new_partial_root(config.root)
        dataset = LeRobotDataset.create(
            config.repo_id,
            fps=config.env.fps,
            features=dataset_features(config),
            root=partial,
            use_videos=False,
        )
        task_description = env.get_wrapper_attr("task_description")
        with episode_bar(report.task, config.episodes) as advance:
            for frames in successful_episodes(env, expert, config, report):
                for frame in frames:
                    dataset.add_frame({**frame, "task": task_description})
                dataset.save_episode()
                advance(1)
        dataset.finalize()
    finally:
        env.close()
    (partial / REPORT_PATH).write_text(json.dumps(asdict(report), indent=2) + "\n")
    partial.rename(config.root)
    return report


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
    disable_progress_bars()  # one bar of the datasets library per episode would tear ours apart
    with command("lerobot-agpd-demos"):
        run()


if __name__ == "__main__":
    main()
