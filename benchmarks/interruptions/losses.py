"""What the journal of a killed run holds, and what its continuation has lost, repeated or left over."""

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_agpd.replay.journal import FRAMES_NAME, EpisodeJournal


@dataclass(frozen=True)
class Snapshot:
    """Records and hashes of frames, by round and episode."""

    records: dict[tuple[int, int], str]
    frames: dict[tuple[int, int], str]

    @classmethod
    def of(cls, root: Path, n_rounds: int) -> "Snapshot":
        """What a journal holds; duplicates raise AssertionError."""
        journal, records, frames = EpisodeJournal(root), {}, {}
        for number in range(n_rounds):
            entries = journal.records(number)
            assert len({entry.number for entry in entries}) == len(entries), "an episode is there twice"
            records |= {(number, entry.number): repr(entry) for entry in entries}
            for episode in journal.kept(number):
                content = b"".join(
                    np.ascontiguousarray(episode.column(key)).tobytes() for key in episode.keys
                )
                frames[number, episode.record.number] = hashlib.sha256(content).hexdigest()
        return cls(records, frames)

    def lost(self, later: "Snapshot") -> list[str]:
        """What a later state lacks or has changed."""
        keys = {key for key, record in self.records.items() if later.records.get(key) != record}
        keys |= {key for key, content in self.frames.items() if later.frames.get(key) != content}
        return [f"lost or changed: {sorted(keys)}"] if keys else []


def leftovers(root: Path, n_rounds: int) -> list[str]:
    """Files of a finished run's journal that belong to nothing."""
    journal, names = EpisodeJournal(root), []
    for path in root.iterdir():
        if path.name not in ("journal.json", "merged") and not path.name.startswith("round-"):
            names.append(path.name)
    for number in range(n_rounds):
        claimed = {episode.path.stem for episode in journal.kept(number)}
        for path in journal.folder(number).iterdir():
            frames = FRAMES_NAME.fullmatch(path.name)
            ours = path.name == "report.json" or path.suffix == ".jsonl"
            if not ours and not (frames and not frames["partial"] and frames["stem"] in claimed):
                names.append(f"{path.parent.name}/{path.name}")
    return names


def check(
    before: Snapshot, output: Path, root: Path, n_rounds: int, n_episodes: int, steps: int
) -> list[str]:
    """What is wrong with a run that was continued to its end.

    Args:
        before: what was there when it was killed.
        output: folder of the last continuation.
        root: folder of the collected episodes.
        n_rounds: that the run has.
        n_episodes: of a round.
        steps: of the run.
    """
    after, journal = Snapshot.of(root, n_rounds), EpisodeJournal(root)
    problems = before.lost(after)
    if sorted(after.records) != [(n, e) for n in range(n_rounds) for e in range(n_episodes)]:
        problems.append(f"episodes {sorted(after.records)}")
    for number, report in enumerate(journal.reports()):
        counts = {"generated": len(journal.records(number)), "kept": len(journal.kept(number))}
        if any(report["total"][name] != count for name, count in counts.items()):
            problems.append(f"report of round {number}: {report['total']}, index: {counts}")
    if len(journal.reports()) != n_rounds:
        problems.append(f"{len(journal.reports())} finished rounds")
    merged = LeRobotDataset("local/merged", root=root / "merged").num_episodes if after.frames else 0
    if merged != len(after.frames):
        problems.append(f"{merged} merged episodes, {len(after.frames)} kept ones")
    if not (output / "checkpoints" / f"{steps:06d}" / "training_state").is_dir():
        problems.append("no last checkpoint")
    return problems + [f"left over: {name}" for name in leftovers(root, n_rounds)]
