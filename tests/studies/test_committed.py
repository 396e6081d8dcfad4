"""Committed results, made under earlier names of flags and keys, as today's package reads them."""

import sys
from pathlib import Path

import pytest

from lerobot_agpd.files import read_json
from lerobot_agpd.rollout.report import success_rate
from lerobot_agpd.studies.frontier import NAMES
from lerobot_agpd.studies.tables import rounds_table

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
sys.path.append(str(BENCHMARKS))
import committed  # noqa: E402

TALLY = {"generated", "solved_at_start", "successful", "kept"}
PARTS = ("strategy", "teacher_only", "retried", "student_alone")


def test_flags_have_todays_names():
    old = {"policy.collect.strategy": "replay", "policy.replay.collected_share": 0.5, "env.type": "robomimic"}
    old |= {"policy.collect.unguided_fraction": 0.2, "policy.collect.mixing.relabel": True, "seed": 1000}
    old |= {"policy.teacher.path": "./examples/quickstart/teacher"}
    assert committed.flags(old) == {
        "policy.collect.strategy": "teacher",
        "policy.replay.collected_fraction": 0.5,
        "env.type": "robosuite_robomimic",
        "policy.collect.teacher_only_fraction": 0.2,
        "policy.collect.mixing.record_teacher": True,
        "policy.teacher.path": "./examples/fetch_pick_and_place/teacher",
        "seed": 1000,
    }


def test_runs_had_another_default_of_guidance():
    flags_of = lambda flags, **more: committed.run({"flags": flags, "rounds": [], **more})["flags"]  # noqa: E731
    assert flags_of({"seed": 1}) == {"seed": 1, "policy.guidance.scale": 0.5}
    assert flags_of({"policy.guidance.scale": 8}) == {"policy.guidance.scale": 8}
    assert flags_of({"seed": 1}, ways=[]) == {"seed": 1}
    assert flags_of({"policy.path": "x"}) == {"policy.path": "x"}, "evaluated only"


@pytest.mark.parametrize(
    "task", sorted(BENCHMARKS.glob("comparison/results/*/*/")), ids=lambda path: path.name
)
def test_rounds_have_todays_keys(task):
    for file in task.glob("*/*/run.json"):
        content = read_json(file)
        for old, new in zip(content["rounds"], committed.run(content)["rounds"], strict=True):
            assert all(set(new[part]) - {"invalid"} == TALLY for part in ("total", *PARTS))
            assert sum(new[part]["generated"] for part in PARTS) == new["total"]["generated"]
            before = old if "total" in old else {**old, "strategy": old["guided"], "strength": old["scale"]}
            assert new["strategy"]["successful"] == before["strategy"]["successful"]
            assert new["strength"] == before["strength"] and committed.round_report(new) == new


def test_reports_and_sweeps_are_read():
    results = committed.read_report(BENCHMARKS / "quickstart/report.json")
    (agpd,) = (result for result in results if result.rounds)
    assert len(agpd.finals["last"].seeds) == len(agpd.finals["last"].successes) >= 100
    assert len(rounds_table(agpd.rounds)) == 1 + len(agpd.rounds) == 6
    assert 0 < success_rate([round_.strategy for round_ in agpd.rounds]) <= 1
    rows = committed.read_sweep(BENCHMARKS / "diversity/fetchpush/sweep.json")
    strategies = {row["setting"]["strategy"] for row in rows}
    assert "teacher" in strategies and strategies <= set(NAMES)
