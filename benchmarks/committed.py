"""Read committed results, whichever words they were made with, as today's package names them.

The JSON files stay as they were written; flags and keys were renamed since. Rendering and the tests go through here.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lerobot_agpd.rollout.report import RoundReport
from lerobot_agpd.studies.evaluation import Evaluation
from lerobot_agpd.studies.latency import Latency
from lerobot_agpd.studies.results import Result

Json = dict[str, Any]

RENAMED_FLAGS = {
    "policy.collect.mixing.relabel": "policy.collect.mixing.record_teacher",
    "policy.collect.unguided_fraction": "policy.collect.teacher_only_fraction",
    "policy.replay.collected_share": "policy.replay.collected_fraction",
}
PICK_AND_PLACE = ("./examples/quickstart/teacher", "./examples/fetch_pick_and_place/teacher")
"""Folder of a teacher until now, and its folder."""

RENAMED_VALUES = {
    ("policy.collect.strategy", "replay"): "teacher",
    ("env.type", "robomimic"): "robosuite_robomimic",
    ("policy.path", PICK_AND_PLACE[0]): PICK_AND_PLACE[1],
    ("policy.teacher.path", PICK_AND_PLACE[0]): PICK_AND_PLACE[1],
}


def flags(old: Mapping[str, Any]) -> Json:
    """Dotted flags under today's names; groups that are constants now keep theirs, and no longer exist."""
    renamed = {RENAMED_FLAGS.get(name, name): value for name, value in old.items()}
    return {
        name: RENAMED_VALUES.get((name, value), value) if isinstance(value, str) else value
        for name, value in renamed.items()
    }


def strategy(name: str) -> str:
    """A strategy's name."""
    return str(RENAMED_VALUES.get(("policy.collect.strategy", name), name))


def tally(old: Mapping[str, int]) -> Json:
    """Counted episodes of one kind."""
    return {("solved_at_start" if key == "trivial" else key): value for key, value in old.items()}


def round_report(old: Mapping[str, Any]) -> Json:
    """The report of a collection round, without its episodes."""
    if "total" in old:
        return {"next_strength" if key == "next_scale" else key: value for key, value in old.items()}
    nothing = {"generated": 0, "trivial": 0, "successful": 0, "kept": 0}
    diagnostics = old.get("diagnostics")
    return {
        "round": old["round"],
        "strength": old["scale"],
        "next_strength": old["next_scale"],
        "step": old["updates"],
        "total": tally({key: old[key] for key in nothing}),
        "strategy": tally(old["guided"]),
        "teacher_only": tally(old["unguided"]),
        "retried": tally(old.get("retried", nothing)),
        "student_alone": tally(old.get("student_alone", nothing)),
        "kept_frames": old["kept_frames"],
        "mean_max_reward": old["mean_max_reward"],
        "mean_discrepancy": old["mean_j_guided"],
        "mean_discrepancy_teacher_only": old["mean_j_unguided"],
        "mean_guidance_shift": old["mean_shift_in_sigmas"],
        "mean_student_steps": old.get("mean_student_steps"),
        "seconds": old["seconds"],
        "diagnostics": diagnostics and {"seconds": 0.0, **diagnostics},
    }


def run(content: Json) -> Json:
    """A `run.json`; those before ways were counted had a scale of 0.5 where they say nothing of guidance."""
    rounds = [round_report(entry) for entry in content["rounds"]]
    renamed = flags(content["flags"])
    if "ways" not in content and "policy.path" not in renamed:
        renamed.setdefault("policy.guidance.scale", 0.5)
    return {**content, "flags": renamed, "rounds": rounds}


def read_report(path: Path) -> list[Result]:
    """The rows of a `report.json`; intervals are computed anew."""
    return [
        Result(
            name=entry["name"],
            finals={"last": Evaluation(**entry["final"])},
            latency=Latency(**entry["latency"]),
            curve={int(step): Evaluation(**values) for step, values in entry["curve"].items()},
            rounds=[
                RoundReport.from_json(round_report(round_))
                for round_ in entry.get("rounds") or entry.get("collection", {}).get("rounds", [])
            ],
        )
        for entry in json.loads(path.read_text())["methods"]
    ]


def read_sweep(path: Path) -> list[Json]:
    """The rows of a `sweep.json`."""
    rows: list[Json] = json.loads(path.read_text())["rows"]
    return [
        {**row, "setting": {**row["setting"], "strategy": strategy(row["setting"]["strategy"])}}
        for row in rows
    ]
