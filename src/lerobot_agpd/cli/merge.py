"""`lerobot-agpd-merge`: the episodes that a run has collected as one LeRobotDataset, and to the Hub."""

import logging
from dataclasses import dataclass
from pathlib import Path

from lerobot_agpd.cli.command import entry_point
from lerobot_agpd.flag_checks import FlagError, require
from lerobot_agpd.replay.export import merge, upload

logger = logging.getLogger(__name__)


@dataclass
class MergeConfig:
    """Options of `lerobot-agpd-merge`; a run that reaches its last step merges by itself."""

    # Folder of a run's collected episodes, <output_dir>/agpd; the run may still be going.
    root: Path
    # Name of the merged dataset, and its Hub repository; default: after the run.
    repo_id: str | None = None
    # Upload it.
    push_to_hub: bool = False

    def __post_init__(self) -> None:
        require(self.root.is_dir(), f"--root={self.root} is not a folder")
        require(not self.push_to_hub or bool(self.repo_id), "--push_to_hub=true needs --repo_id")


@entry_point("lerobot-agpd-merge")
def main(config: MergeConfig) -> None:
    """Merge all kept episodes, and upload."""
    merged = merge(config.root, config.repo_id)
    if merged is None:
        raise FlagError(f"--root={config.root} holds no kept episode")
    logger.info("%d episodes, %d frames in %s", merged.num_episodes, merged.num_frames, merged.root)
    if config.push_to_hub:
        upload(merged, config.root)
        logger.info("uploaded to %s", config.repo_id)


if __name__ == "__main__":
    main()
