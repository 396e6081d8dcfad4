"""The dataset card of collected episodes: who acted, where, which were kept, and what the added columns mean."""

from __future__ import annotations

from typing import Any

from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.datasets.utils import create_lerobot_dataset_card

from lerobot_agpd.files import write_text
from lerobot_agpd.replay.journal import EpisodeJournal

CARD = "README.md"
LICENSE = "apache-2.0"

DESCRIPTION = """\
Episodes that a teacher generated in simulation, and that passed the success filter, while a faster policy was distilled
from it (*Adaptive Guidance Policy Distillation*, by the LeRobot plugin lerobot_policy_agpd). The demonstrations of that run are
not part of the dataset.

| | |
| --- | --- |
{rows}

Columns beside those of the demonstrations: `agpd.round` is the collection round from 0; `agpd.strength` the strength of
guidance (0: the teacher acted alone); `agpd.strategy` who acted, `teacher` where it was the teacher alone.

| round | generated | succeeded | kept | kept frames |
| --- | --- | --- | --- | --- |
{rounds}"""


def card_options(journal: EpisodeJournal) -> dict[str, Any]:
    """Arguments of `LeRobotDataset.push_to_hub` that decide its card."""
    identity = journal.header["identity"]
    environment = identity.get("environment") or {}
    facts = {
        "environment": " ".join(f"`{value}`" for value in environment.values() if value),
        "task": journal.header["task"],
        "teacher": f"`{identity['teacher']}`" if identity.get("teacher") else "",
        "who acted": f"`{identity['strategy']}`" if identity.get("strategy") else "",
        "kept if": _criterion(identity),
    }
    description = DESCRIPTION.format(
        rows="\n".join(f"| {name} | {value} |" for name, value in facts.items() if value),
        rounds="\n".join(_rounds(journal)),
    )
    return {"tags": ["agpd", "policy-distillation"], "license": LICENSE, "dataset_description": description}


def write_card(dataset: LeRobotDataset, journal: EpisodeJournal) -> None:
    """Write the card that an upload would get into the dataset's folder."""
    card = create_lerobot_dataset_card(
        dataset_info=dataset.meta.info, repo_id=dataset.repo_id, **card_options(journal)
    )
    write_text(dataset.root / CARD, str(card))


def _criterion(identity: dict[str, Any]) -> str:
    if identity.get("collect.keep_failures"):
        return "always"
    reward = identity.get("collect.min_reward")
    return "`is_success` at the last step" if reward is None else f"the largest reward was at least {reward}"


def _rounds(journal: EpisodeJournal) -> list[str]:
    """A row per round; the last may be unfinished."""
    rows = []
    for number in journal.rounds():
        records = journal.records(number)
        kept = [record for record in records if record.kept]
        counts = (len(records), sum(record.success for record in records), len(kept))
        cells = (number, *counts, sum(record.length for record in kept))
        rows.append("| " + " | ".join(map(str, cells)) + " |")
    return rows
