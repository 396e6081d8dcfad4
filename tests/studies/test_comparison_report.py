"""Differences, tables, pictures and reports of known results."""

from dataclasses import asdict, replace

import matplotlib.image
import numpy as np
import pytest
from matrices import changed, collected, content, evaluation, load, tally
from scipy.stats import t

from lerobot_agpd.files import read_json, write_json
from lerobot_agpd.rollout.report import RoundReport
from lerobot_agpd.studies.comparison import Comparison, write_pictures
from lerobot_agpd.studies.curves import draw_report_curves, mean_curve
from lerobot_agpd.studies.latency import Latency
from lerobot_agpd.studies.provenance import digest
from lerobot_agpd.studies.report import comparison_report, write_summary
from lerobot_agpd.studies.results import difference, pooled
from lerobot_agpd.studies.run_results import RESULT, read_result, read_results
from lerobot_agpd.studies.runs import expand
from lerobot_agpd.studies.statistics import success_rate
from lerobot_agpd.studies.tables import (
    collection_table,
    cost_table,
    difference_cell,
    difference_table,
    results_table,
    rounds_table,
    summary_table,
)

pytest.importorskip("lerobot_policy_agpd")  # registers the policy and environment types


def store(run, matrix, best, last, curve=None, rounds=(), seconds=None, adopted=0, torch="2") -> None:
    write_json(
        run.folder / RESULT,
        {
            "flags": run.flags,
            "evaluation": asdict(matrix.evaluation),
            "measure": matrix.tasks[run.task].measure,
            "steps": None if run.policy else 20,
            "curve": {step: asdict(evaluation(values, 500_000)) for step, values in (curve or {}).items()},
            "best": {"step": 10, **asdict(evaluation(best))},
            "last": {"step": 20, **asdict(evaluation(last))},
            "latency": asdict(Latency(2.0, 3.0, 1_500_000, 1)),
            "weights": digest(run.policy) if run.policy else None,
            "rounds": list(rounds),
            "seconds": seconds or {"total": 50.0},
            "starts": [{"rounds_adopted": adopted, "git": None, "versions": {"torch": "2"}}],
            "evaluated_with": {"git": None, "versions": {"torch": torch}},
        },
    )


def as_reports(*rounds: dict) -> list[RoundReport]:
    return [RoundReport.from_json(entry) for entry in rounds]


@pytest.fixture
def compared(tmp_path):
    """Two methods with two training seeds, a teacher, four environments; outcomes known."""
    matrix = load(tmp_path, content(tmp_path))
    runs = {run.name: run for run in expand(matrix)}
    for run in runs.values():
        run.folder.mkdir(parents=True)
    curve = {10: [1, 1], 20: [1, 0]}
    store(runs["pusht/bc/seed-1"], matrix, [1, 0, 0, 0], [0, 0, 0, 0], curve)
    store(runs["pusht/bc/seed-2"], matrix, [1, 1, 0, 0], [1, 0, 0, 0], {10: [0, 0], 20: [1, 1]})
    round_ = collected(strategy=(6, 6, 5), teacher_only=(4, 2, 2))
    spent = {"total": 60.0, "teacher": 20.0, "environment": 10.0}
    store(runs["pusht/agpd/seed-1"], matrix, [1, 1, 1, 0], [1, 1, 0, 0], curve, [round_, round_], spent)
    store(runs["pusht/agpd/seed-2"], matrix, [1, 1, 1, 1], [1, 1, 1, 0], curve, [round_], spent, adopted=1)
    store(runs["pusht/teacher/policy"], matrix, [1, 1, 1, 0], [1, 1, 1, 0])
    results = {}
    for run in runs.values():
        results.setdefault(run.method, []).append(read_result(run, matrix))
    return matrix, results


def test_differences_are_paired_by_seed_and_environment(compared):
    _, results = compared
    found = difference(results["agpd"], results["bc"], "best", "success")
    # differences [[0, 1, 1, 0], [0, 0, 1, 1]]: equal row means, so MS_seed = 0 is replaced by MS_rest;
    # column means 0, .5, 1, .5 about .5: MS_environment = 2 * .5 / 3 = 1/3; residuals 0, +-.5, 0, +-.5: MS_rest = 1/3
    half = t.ppf(0.975, 1) * np.sqrt(1 / 3 / 8)
    assert found.mean == 0.5 and found.n_seeds == 2
    assert (found.low, found.high) == pytest.approx((0.5 - half, 0.5 + half))
    against_teacher = difference(results["agpd"], results["teacher"], "last", "success")
    assert against_teacher.mean == pytest.approx((2 / 4 + 3 / 4) / 2 - 3 / 4) and against_teacher.n_seeds == 2
    assert difference(results["teacher"], results["bc"], "last", "max_reward").mean == pytest.approx(
        0.5 * (0.75 - 0.125)
    )
    assert difference(results["bc"][:1], results["agpd"][1:], "best", "success") is None


def test_what_a_method_reached(compared):
    _, results = compared
    header, *rows = results_table(results, "success", 3)
    row = dict(zip(header, rows[1], strict=True))
    assert (row[""], row["training seeds"], row["gradient steps"]) == ("agpd", "2 of 3", "20")
    assert row["success rate, last"].startswith("0.62 [") and row["by seed"] == "0.50 / 0.75"
    assert row["success rate, best"].startswith("0.88 [")
    teacher = dict(zip(header, rows[2], strict=True))
    assert (teacher["training seeds"], teacher["by seed"], teacher["success rate, best"]) == ("-",) * 3


def test_rewards_are_shown_where_they_add_something(compared, tmp_path):
    _, results = compared
    header, *rows = results_table(results, "max_reward", 2)
    assert header[3:] == (
        "mean max reward, last",
        "by seed",
        "mean max reward, best",
        "success rate, last",
        "success rate, best",
    ), "the task's own measure first"
    assert rows[1][4] == "0.25 / 0.38", "of that measure"
    assert "mean max reward, last" in results_table(results, "success", 2)[0], "half a success here"
    told_by_success = [
        replace(result, finals={name: same_reward(final) for name, final in result.finals.items()})
        for result in results["bc"]
    ]
    assert "mean max reward, last" not in results_table({"bc": told_by_success}, "success", 2)[0]


def same_reward(final):
    """Fetch's: -1 until the goal is reached, then 0."""
    return replace(final, max_rewards=[success - 1.0 for success in final.successes])


def test_what_a_method_cost(compared):
    _, results = compared
    header, _, agpd, teacher = cost_table(results)
    assert all(len(row) == len(header) for row in (agpd, teacher))
    assert agpd[:2] == ("agpd", "15 / 12 / 10"), "means per training seed"
    assert agpd[2:] == ("60 s: environment 10, teacher 20, training 30", "1.50 M")
    assert teacher[1:3] == ("-", "-")


def test_one_training_seed_is_never_bold(compared):
    _, results = compared
    better = replace(results["agpd"][0], finals={"last": evaluation([1] * 39 + [0])})
    worse = replace(results["bc"][0], finals={"last": evaluation([0] * 40)})
    one = difference_cell([better], [worse], "last", "success")
    assert one.startswith("+0.97 [") and one.endswith("]¹"), "it says nothing about other seeds"
    others = [replace(result, run=replace(result.run, seed=2)) for result in (better, worse)]
    two = difference_cell([better, others[0]], [worse, others[1]], "last", "success")
    assert two.startswith("**+0.97 [") and two.endswith("]**²")
    assert difference_cell([better], [], "last", "success") == "-"


def test_collection_rounds_are_pooled_and_averaged(compared):
    _, results = compared
    run = replace(
        results["agpd"][0],
        rounds=as_reports(
            collected((8, 6, 6), (2, 1, 1), {"rms_to_teacher": 0.1}, {"entropy": -1.0, "coverage": None}),
            collected((8, 2, 2), (0, 0, 0), {"rms_to_teacher": 0.3}, {"entropy": -2.0, "coverage": 0.5}),
        ),
    )
    header, *rows = collection_table({"bc": results["bc"], "agpd": [run]})
    assert rows == [
        ("agpd", "0.50", "0.50", "0.50", "0.200", "-", "-", "-", "-", "-1.50", "0.50", "3"),
    ], "8 of 16 by the strategy, 1 of 2 by the teacher; nothing of a method without rounds"
    assert len(rows[0]) == len(header)
    assert collection_table({"bc": results["bc"]}) == []


def test_rounds_one_by_one():
    solved = {"strategy": tally(8, 2, 2, 3), "teacher_only": tally(1, 0, 0, 1), "mean_guidance_shift": None}
    second_round = {**collected((8, 2, 2), (1, 0, 0)), "round": 1, **solved}
    rounds = as_reports(collected((6, 6, 5), (4, 2, 2)), second_round)
    _, first, second = rounds_table(rounds)
    assert first == ("0", "0.5", "6 / 6", "2 / 4", "10", "7", "0.50", "3")
    assert second == ("1", "0.5", "2 / 5", "-", "9", "2", "-", "3")


@pytest.mark.parametrize(
    ("where", "value"), [("env.obs_type", "pixels"), ("teacher", "other")], ids=["environment", "policy"]
)
def test_a_policy_is_evaluated_anew_if_it_or_its_environment_changed(compared, tmp_path, where, value):
    matrix, _ = compared
    (tmp_path / "other").mkdir()
    value = str(tmp_path / value) if where == "teacher" else value
    now = load(tmp_path, changed(content(tmp_path), f"tasks.pusht.{where}", value))
    teacher = next(run for run in expand(now) if run.policy)
    with pytest.raises(ValueError, match="made with other flags"):
        read_result(teacher, now)
    assert Comparison(tmp_path / "matrix.yaml", now).needs_work(teacher)


def test_a_policy_is_evaluated_anew_if_its_weights_changed(compared, tmp_path):
    matrix, _ = compared
    teacher = next(run for run in expand(matrix) if run.policy)
    comparison = Comparison(tmp_path / "matrix.yaml", matrix)
    assert not comparison.needs_work(teacher)
    (tmp_path / "teacher" / "model.safetensors").write_bytes(b"trained again")
    assert comparison.needs_work(teacher)


def test_results_are_those_of_the_whole_matrix(compared):
    matrix, _ = compared
    first = expand(matrix)[0]
    (first.folder / RESULT).write_text("{}")
    found, missing = read_results(matrix)
    assert {name: len(runs) for name, runs in found["pusht"].items()} == {"bc": 1, "agpd": 2, "teacher": 1}
    assert missing == [first.name], "a damaged one is named, not fatal"


def test_the_report_says_what_is_missing_and_what_was_disturbed(compared):
    matrix, results = compared
    text = comparison_report(
        matrix, {"pusht": results}, ["pusht/dagger/seed-1", "pusht/pd/seed-1", "pusht/pd/seed-2"]
    )
    assert (
        "## pusht" in text and "Not finished: seed-1 of pusht/dagger; seed-1, seed-2 of pusht/pd.**" in text
    )
    assert "`agpd`: the whole method" in text and "pusht/agpd/seed-2 (1)" in text
    assert "same packages" not in text
    assert "| agpd | +0.50 [" in text and "4 other environments (seeds from 100000)" in text


def test_the_report_says_if_packages_changed_on_the_way(compared):
    matrix, results = compared
    run = results["bc"][0].run
    store(run, matrix, [1, 0, 0, 0], [0, 0, 0, 0], {10: [1, 1], 20: [1, 0]}, torch="3")
    results["bc"][0] = read_result(run, matrix)
    text = comparison_report(matrix, {"pusht": results}, [])
    assert "Not all of pusht was made with the same packages: " in text


def test_the_report_names_runs_that_another_teacher_taught(compared):
    matrix, results = compared

    def text(*fingerprints: str) -> str:
        taught = [
            replace(result, made_with={**result.made_with, "teacher": frozenset([name])})
            for result, name in zip(results["agpd"], fingerprints, strict=True)
        ]
        return comparison_report(matrix, {"pusht": {**results, "agpd": taught}}, [])

    evaluated = results["teacher"][0].weights
    assert "the same teacher" not in text(evaluated, evaluated)
    remark = "Not all of pusht was made with the same teacher: "
    same, other = "seed-1 of pusht/agpd", "seed-2 of pusht/agpd"
    assert f"{remark}{same}; policy of pusht/teacher / {other}.**" in text(evaluated, "another")
    both = "seed-1, seed-2 of pusht/agpd / policy of pusht/teacher"
    assert f"{remark}{both}.**" in text("another", "another")


def test_differences_without_spread_are_not_shown_as_certain(compared):
    _, results = compared
    rows = difference_table({"a": results["bc"], "b": results["bc"]}, ["a", "b"], "last", "success")
    assert rows[1:] == [("a", "", "+0.00² (in every pair)"), ("b", "+0.00² (in every pair)", "")]


def test_all_are_compared_with_the_references(compared, tmp_path):
    matrix, results = compared
    text = comparison_report(
        load(tmp_path, content(tmp_path) | {"references": ["bc"]}), {"pusht": results}, []
    )
    assert "|  | bc |" in text.splitlines()
    assert "|  | bc | agpd | teacher |" in comparison_report(matrix, {"pusht": results}, []), "by default all"


def test_pictures_show_every_task_and_method(compared, tmp_path):
    matrix, results = compared
    write_pictures(matrix, {"pusht": results}, tmp_path)
    text = comparison_report(matrix, {"pusht": results}, [], "figures/")
    for name in ("outcomes-pusht.png", "curves-pusht.png"):
        assert matplotlib.image.imread(tmp_path / name).std() > 0 and f"](figures/{name})" in text


def test_pooled_measures_treat_episodes_alike(compared):
    _, results = compared
    assert pooled(results["agpd"], "last", "success") == success_rate([True] * 5 + [False] * 3)
    rewards = pooled(results["agpd"], "last", "max_reward")
    assert rewards.mean == 0.3125 and rewards.n == 8


def test_curves_are_means_over_training_seeds(compared):
    _, results = compared
    steps, values = mean_curve(results["bc"], "success")
    assert steps.tolist() == [10, 20] and values.tolist() == [[1, 0.5], [0, 1]]


def test_some_runs_side_by_side(compared, tmp_path):
    """What lerobot-agpd-report makes of its results."""
    _, results = compared
    shown = [results["teacher"][0], results["agpd"][0]]
    header, teacher, agpd = summary_table(shown)
    row = dict(zip(header, agpd, strict=True))
    assert row["success"] == str(success_rate([True, True, False, False])) and row["N"] == "4"
    assert row["episodes generated / kept"] == "20 / 14" and teacher[4] == "-"
    write_summary(shown, {"type": "pusht"}, 100_000, tmp_path)
    entries = read_json(tmp_path / "report.json")["methods"]
    assert [entry["final"]["successes"] for entry in entries] == [r.finals["last"].successes for r in shown]
    assert entries[1]["success"]["mean"] == 0.5 and len(entries[1]["rounds"]) == 2
    assert agpd[0] in (tmp_path / "report.md").read_text()
    draw_report_curves(shown, "a title", tmp_path / "curves.png")
    assert matplotlib.image.imread(tmp_path / "curves.png").std() > 0


def test_a_result_is_trusted_only_if_whole_and_of_this_matrix(compared, tmp_path):
    matrix, results = compared
    run = results["bc"][0].run
    matrix.evaluation.episodes = 5
    with pytest.raises(ValueError, match="other evaluation than the matrix has now"):
        read_result(run, matrix)
    path = run.folder / RESULT
    text = path.read_text()
    path.write_text(text[: len(text) // 2])
    with pytest.raises(ValueError, match=r"run\.json is damaged"):
        read_result(run, matrix)
    path.unlink()
    assert read_result(run, matrix) is None
