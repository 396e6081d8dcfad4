"""Flags of the replay."""

from __future__ import annotations

from dataclasses import dataclass

from lerobot_agpd.guidance.config import require

RELABEL = ("none", "demonstrations", "all")


@dataclass
class ReplayConfig:
    """The replay T: demonstrations plus every kept episode."""

    root: str | None = None  # folder of the collected episodes; default: <output_dir>/agpd
    collected_share: float | None = (
        None  # share of every batch that collected frames fill; default: uniform over T
    )

    relabel: str = (
        "none"  # whose chunks are exchanged for the teacher's own: none, demonstrations or all of T
    )

    def __post_init__(self) -> None:
        require(
            self.relabel in RELABEL,
            f"--policy.replay.relabel must be one of {list(RELABEL)}, got '{self.relabel}'",
        )
        require(
            self.collected_share is None or 0 <= self.collected_share < 1,
            f"--policy.replay.collected_share must be in [0, 1), got {self.collected_share}",
        )
