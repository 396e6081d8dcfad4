"""`lerobot-agpd-import-adroit`: DAPG's human demonstrations with the Adroit hand as a LeRobotDataset.

The recorded actions are played again in `--env.type=gymnasium_robotics`, from the recorded state, and what the environment
shows is stored. `meta/dapg.json` says how far every episode went from the recording, and whether it succeeded.
"""

import json
import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from datasets import disable_progress_bars
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_agpd.cli.command import entry_point
from lerobot_agpd.cli.progress import episode_bar
from lerobot_agpd.dataset_writer import DatasetWriter, Frame
from lerobot_agpd.envs.dapg_recordings import Recording, read_recordings
from lerobot_agpd.envs.demonstrations import dataset_features
from lerobot_agpd.envs.gymnasium_robotics import GymnasiumRoboticsEnv
from lerobot_agpd.envs.replayed_recordings import Replay, replay
from lerobot_agpd.flag_checks import require

logger = logging.getLogger(__name__)

REPORT_PATH = Path("meta/dapg.json")

Kept = Literal["all", "successful"]


@dataclass
class ImportAdroitConfig:
    """Options of `lerobot-agpd-import-adroit`."""

    # DAPG's pickle, e.g. door-v0_demos.pickle, or an .npz file with its arrays.
    source: Path
    # Folder of the new dataset; must not exist.
    root: Path
    # Name of the new dataset.
    repo_id: str = "local/adroit"
    # Episodes to keep, e.g. "[0,1,2]"; default: all.
    episodes: list[int] | None = None
    # Of these, keep all, or the successful: those that reach the environment's goal at some step of the replay.
    keep: Kept = "all"
    # Upload the dataset when it is done.
    push_to_hub: bool = False

    def __post_init__(self) -> None:
        """Check the options.

        Raises:
            FlagError: if an option is impossible.
        """
        require(not self.root.exists(), f"--root={self.root} already exists; choose a new folder")
        require(
            self.source.is_file(), f"--source={self.source} is not a file; expected DAPG's pickle or an .npz"
        )
        if self.episodes is not None:
            require(
                min(self.episodes, default=-1) >= 0 and len(set(self.episodes)) == len(self.episodes),
                f"--episodes={self.episodes} must name at least one episode, counted from 0, and none twice",
            )


@dataclass
class AdroitReport:
    """What was imported; written to `meta/dapg.json` in the dataset.

    Attributes:
        source: name of the file.
        task: of the environment.
        episode_length: steps of the longest kept episode; the `--env.episode_length` that replaying them takes.
        episodes: one entry per kept episode, in order.
        left_out: one per episode that did not succeed, if only successful ones are kept.
    """

    source: str
    task: str
    episode_length: int = 0
    episodes: list[dict[str, Any]] = field(default_factory=list)
    left_out: list[dict[str, Any]] = field(default_factory=list)

    def add(self, episode: int, played: Replay, kept: bool) -> None:
        """Count one episode of the file."""
        entry = {
            "episode": episode,
            "length": len(played.frames),
            "success_at_any_step": played.success_at_any_step,
            "success_at_last_step": played.success_at_last_step,
            "clipped": played.clipped,
            "deviation_at_start": float(played.deviations[0]),
            "mean_deviation": float(played.deviations.mean()),
        }
        (self.episodes if kept else self.left_out).append(entry)
        if kept:
            self.episode_length = max(self.episode_length, len(played.frames))


def import_adroit(config: ImportAdroitConfig) -> tuple[LeRobotDataset, AdroitReport]:
    """Write the dataset.

    Raises:
        ValueError: if the file does not have a requested episode, or none is kept; see also `read_recordings`.
        ModuleNotFoundError: if Gymnasium-Robotics is not installed.
    """
    recordings = read_recordings(config.source)
    episodes = config.episodes or list(range(len(recordings)))
    if max(episodes) >= len(recordings):
        raise ValueError(
            f"--episodes={config.episodes}: {config.source} has {len(recordings)} episodes, 0 to {len(recordings) - 1}"
        )
    chosen = {episode: recordings[episode] for episode in episodes}
    limit = max(len(recording) for recording in chosen.values())
    env = GymnasiumRoboticsEnv(task=recordings[0].task, episode_length=limit)
    report = AdroitReport(source=config.source.name, task=recordings[0].task)

    def add_report(folder: Path) -> None:
        (folder / REPORT_PATH).write_text(json.dumps(vars(report), indent=2) + "\n")

    assert env.fps is not None  # filled in from the task
    writer = DatasetWriter(config.root, config.repo_id, env.fps, dataset_features(env))
    with episode_bar("episodes", len(chosen)) as advance:
        frames = replayed_episodes(chosen, env, config, report, lambda: advance(1))
        return writer.write(frames, add_files=add_report), report


def replayed_episodes(
    recordings: dict[int, Recording],
    env_config: GymnasiumRoboticsEnv,
    config: ImportAdroitConfig,
    report: AdroitReport,
    on_episode: Callable[[], None],
) -> Iterator[list[Frame]]:
    """Yield the frames of every kept episode.

    Raises:
        ValueError: if only successful episodes are kept and there is none.
    """
    env = env_config.make_single()
    try:
        for episode, recording in recordings.items():
            played = replay(env, recording, env_config.features_map)
            kept = config.keep == "all" or played.success_at_any_step
            report.add(episode, played, kept)
            on_episode()
            if kept:
                yield played.frames
    finally:
        env.close()
    if not report.episodes:
        raise ValueError(
            f"--keep={config.keep}: none of {len(recordings)} episodes reaches the goal of {report.task} at replay"
        )


@entry_point("lerobot-agpd-import-adroit")
def main(config: ImportAdroitConfig) -> None:
    """Import, report and optionally upload."""
    disable_progress_bars()  # one bar of the datasets library per episode would tear ours apart
    dataset, report = import_adroit(config)
    n_successful = sum(entry["success_at_any_step"] for entry in report.episodes)
    logger.info("%d episodes, %d frames in %s", dataset.num_episodes, dataset.num_frames, config.root)
    logger.info(
        "%d of them reach the goal; replay them with --env.type=gymnasium_robotics --env.task=%s --env.episode_length=%d",
        n_successful,
        report.task,
        report.episode_length,
    )
    if config.push_to_hub:
        dataset.push_to_hub()


if __name__ == "__main__":
    main()
