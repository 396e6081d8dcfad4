"""The matrix, its runs, what their folders say, and the report."""

import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.stats import t

from lerobot_agpd.analysis.evaluation import Evaluation
from lerobot_agpd.analysis.latency import Latency
from lerobot_agpd.comparison.curves import draw_curves, mean_curve
from lerobot_agpd.comparison.evaluations import RESULT, best_step, read_evaluation
from lerobot_agpd.comparison.files import read_json, write_json
from lerobot_agpd.comparison.matrix import flat, load_matrix
from lerobot_agpd.comparison.results import compare, read_result
from lerobot_agpd.comparison.rounds import HEADER, collection_rows
from lerobot_agpd.comparison.runs import check, environment, expand, parse_flags
from lerobot_agpd.comparison.table import difference_rows, method_row, report, training_time
from lerobot_agpd.comparison.training import (
    StartLog,
    check_same_command,
    last_checkpoint,
    prepare,
    progress,
    read_starts,
    replay_parent,
    train_command,
)

pytest.importorskip("lerobot_policy_agpd")  # registers the policy and environment types

ROOT = Path(__file__).parents[2]


def content(tmp_path: Path) -> dict:
    for name in ("teacher", "demos"):
        (tmp_path / name).mkdir(exist_ok=True)
    return {
        "tasks": {
            "pusht": {
                "env": {"type": "pusht", "obs_type": "environment_state_agent_pos"},
                "dataset": {"repo_id": "local/x", "root": str(tmp_path / "demos"), "episodes": [0, 1]},
                "teacher": str(tmp_path / "teacher"),
                "flags": {"steps": 20},
            }
        },
        "methods": {
            "bc": {"teacher": False, "flags": {"policy": {"collect": {"every": 0}, "adversary.weight": 0}}},
            "agpd": {"note": "the whole method"},
            "teacher": {"policy": "{teacher}"},
        },
        "seeds": [1, 2],
        "common": {"steps": 10, "policy": {"type": "agpd", "push_to_hub": False, "collect": {"every": 7}}},
        "evaluation": {"episodes": 4, "curve_episodes": 2},
        "output": str(tmp_path / "out"),
    }


def load(tmp_path: Path, entries: dict):
    path = tmp_path / "matrix.yaml"
    path.write_text(yaml.safe_dump(entries, sort_keys=False))
    return load_matrix(path)


def changed(entries: dict, where: str, value) -> dict:
    *parents, last = where.split(".")
    inner = entries
    for name in parents:
        inner = inner[name]
    inner[last] = value
    return entries


# ---- the matrix ----


def test_expansion_layers_flags_and_names_folders(tmp_path):
    matrix = load(tmp_path, content(tmp_path))
    runs = expand(matrix)
    assert [run.name for run in runs] == [
        "pusht/bc/seed-1",
        "pusht/agpd/seed-1",
        "pusht/teacher/policy",
        "pusht/bc/seed-2",
        "pusht/agpd/seed-2",
    ]
    bc, agpd, teacher = runs[:3]
    assert bc.flags["steps"] == 20, "a task's flags override common ones"
    assert bc.flags["policy.collect.every"] == 0 and agpd.flags["policy.collect.every"] == 7
    assert "policy.teacher.path" not in bc.flags
    assert agpd.flags["policy.teacher.path"] == teacher.policy == str(tmp_path / "teacher")
    assert teacher.seed is None and not teacher.flags
    words = bc.words
    assert (
        "--dataset.episodes=[0, 1]" in words and "--policy.push_to_hub=false" in words and "--seed=1" in words
    )
    check(matrix, runs)


def test_a_part_of_the_matrix(tmp_path):
    matrix = load(tmp_path, content(tmp_path))
    assert [run.name for run in expand(matrix, ["pusht"], ["agpd"], [2])] == ["pusht/agpd/seed-2"]
    for part, flag in (
        (([], ["ppo"], []), "methods"),
        ((["lift"], [], []), "tasks"),
        (([], [], [9]), "seeds"),
    ):
        with pytest.raises(ValueError, match=f"--{flag}: the matrix has no .* there are"):
            expand(matrix, *part)


@pytest.mark.parametrize(
    ("where", "value", "message"),
    [
        ("sedes", [1], r"unknown entries \['sedes'\]"),
        ("tasks.pusht.flag", {}, r"tasks.pusht: unknown entries \['flag'\]"),
        ("tasks.pusht.measure", "reward", "tasks.pusht.*must be one of"),
        ("tasks.pusht.env", {"obs_type": "x"}, "env needs a type"),
        ("tasks.pusht.teacher", "", "method 'agpd' takes a teacher and tasks.pusht names none"),
        ("methods.agpd", {"policy": "x", "flags": {"steps": 1}}, "only evaluated"),
        ("methods.agpd.flags", {"seed": 3}, "methods.agpd.flags sets 'seed'"),
        ("common.output_dir", "x", "common sets 'output_dir'"),
        ("seeds", [1, 1], "different training seeds"),
        ("seeds", ["a"], "list of integers"),
        ("seeds", [100_000], r"training seeds lie in \[0, 100000\)"),
        ("output", None, "output is missing"),
        ("output", "${NOT_SET_ANYWHERE}/x", "NOT_SET_ANYWHERE"),
        ("evaluation.seed", 5, "leave the seeds that training and collection never use"),
        ("evaluation.curve_seed", 100_003, "overlap"),
        ("evaluation.batch_size", 0, "batch_size must be at least 1"),
    ],
)
def test_a_wrong_matrix_is_refused(tmp_path, where, value, message):
    with pytest.raises(ValueError, match=message) as caught:
        load(tmp_path, changed(content(tmp_path), where, value))
    assert "matrix.yaml" in str(caught.value)


@pytest.mark.parametrize(
    ("where", "value", "message"),
    [
        ("methods.bc.flags", {"policy.colect.every": 0}, r"method 'bc'.*unrecognized.*policy\.colect\.every"),
        ("methods.bc.flags", {"policy.collect.every": -1}, "method 'bc'.*must not be negative"),
        ("common.policy", {"type": "agdp"}, "invalid choice: 'agdp'"),
        ("common.policy", {"type": "agpd"}, "push_to_hub is on"),
        ("tasks.pusht.env", {"type": "pusht", "nix": 1}, "env: .*nix"),
        ("tasks.pusht.env", {"type": "pushd"}, "env: .*pushd"),
        ("tasks.pusht.teacher", "/no/such/teacher", "policy.teacher.path '/no/such/teacher' does not exist"),
    ],
)
def test_a_command_that_cannot_work_is_refused_before_it_starts(tmp_path, where, value, message):
    matrix = load(tmp_path, changed(content(tmp_path), where, value))
    with pytest.raises(ValueError, match=message):
        check(matrix, expand(matrix))


def test_variables_of_the_environment(tmp_path, monkeypatch):
    monkeypatch.setenv("RUNS", str(tmp_path))
    assert load(tmp_path, changed(content(tmp_path), "output", "${RUNS}/here")).output == tmp_path / "here"


def test_nested_and_dotted_flags_are_the_same():
    assert flat({"a": {"b": 1, "c.d": 2}, "e": [3]}) == {"a.b": 1, "a.c.d": 2, "e": [3]}


@pytest.mark.parametrize(
    "path", sorted((ROOT / "benchmarks" / "comparison").glob("*.yaml")), ids=lambda p: p.stem
)
def test_the_flags_of_committed_matrices_exist(path, monkeypatch, tmp_path):
    monkeypatch.setenv("AGPD_RUNS", str(tmp_path))
    monkeypatch.chdir(ROOT)
    matrix = load_matrix(path)
    for run in expand(matrix, seeds=matrix.seeds[:1]):
        environment(matrix.tasks[run.task])
        if not run.policy:
            parse_flags(run.words)


# ---- what a folder says ----


def checkpoint(run, step: int, steps: int, rounds: int = 0) -> None:
    """What progress reads of a LeRobot checkpoint."""
    folder = run.output_dir / "checkpoints" / f"{step:06d}"
    write_files = {
        "pretrained_model/train_config.json": {"steps": steps},
        "pretrained_model/agpd_state.json": {"rounds": rounds},
        "training_state/training_step.json": {"step": step},
    }
    for name, entries in write_files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(json.dumps(entries))
    link = folder.parent / "last"
    link.unlink(missing_ok=True)
    link.symlink_to(folder.name)


@pytest.fixture
def one_run(tmp_path):
    return expand(load(tmp_path, content(tmp_path)), methods=["agpd"], seeds=[1])[0]


def test_a_new_run_starts_and_an_interrupted_one_resumes(one_run):
    assert train_command(one_run) == ["lerobot-train", *one_run.words, f"--output_dir={one_run.output_dir}"]
    checkpoint(one_run, 10, 20)
    (one_run.output_dir / "checkpoints" / "000015").mkdir()  # killed while saving: not linked, not trusted
    prepare(one_run)
    reached = progress(one_run)
    assert (reached.step, reached.steps, reached.finished) == (10, 20, False)
    last = one_run.output_dir / "checkpoints" / "last" / "pretrained_model" / "train_config.json"
    assert train_command(one_run)[1:] == [
        f"--config_path={last}",
        "--resume=true",
        f"--output_dir={one_run.output_dir}",
    ]
    checkpoint(one_run, 20, 20)
    assert progress(one_run).finished


def test_without_a_checkpoint_a_run_starts_anew_and_keeps_its_rounds(one_run):
    (one_run.output_dir / "checkpoints" / "000010").mkdir(parents=True)
    prepare(one_run)
    assert not one_run.output_dir.exists() and last_checkpoint(one_run) is None
    round_ = one_run.output_dir / "agpd" / "round-000"
    round_.mkdir(parents=True)
    prepare(one_run)
    assert not one_run.output_dir.exists() and (one_run.folder / "agpd" / "round-000").is_dir()
    assert train_command(one_run)[-1] == f"--policy.replay.root={one_run.folder / 'agpd'}"
    assert replay_parent(one_run) == one_run.folder
    prepare(one_run)
    assert (one_run.folder / "agpd" / "round-000").is_dir(), "a second interruption loses nothing either"


def test_other_flags_are_refused(one_run, tmp_path):
    prepare(one_run)
    check_same_command(one_run)
    other = load(tmp_path, changed(content(tmp_path), "methods.agpd.flags", {"batch_size": 3}))
    with pytest.raises(ValueError, match="started with other flags .batch_size: - -> 3"):
        check_same_command(expand(other, methods=["agpd"], seeds=[1])[0])


def test_starts_are_remembered_with_their_time_and_early_rounds(one_run):
    prepare(one_run)
    StartLog(one_run).begin(one_run, ["lerobot-train"], threads=1)
    (one_run.folder / "train.log").write_text("alive")  # and killed without a word
    checkpoint(one_run, 10, 20, rounds=1)
    for number in range(3):
        (one_run.output_dir / "agpd" / f"round-00{number}").mkdir(parents=True)
    again = StartLog(one_run)
    again.begin(one_run, ["lerobot-train", "--resume=true"], threads=2)
    again.end(0)
    first, second = read_starts(one_run)
    assert first["interrupted"] and 0 <= first["seconds"] < 60 and first["rounds_adopted"] == 0
    assert (second["from_step"], second["rounds_adopted"], second["returncode"]) == (10, 2, 0)
    assert first["versions"]["lerobot"] and first["host"]["cores"]


# ---- evaluations ----


def evaluation(successes, seed=100_000) -> Evaluation:
    return Evaluation(
        successes=[bool(value) for value in successes],
        max_rewards=[0.5 * value for value in map(float, successes)],
        seeds=list(range(seed, seed + len(successes))),
    )


def test_stored_evaluations_are_trusted_only_if_whole_and_as_asked(tmp_path):
    file, request = tmp_path / "final.json", {"seed": 100_000, "episodes": 3, "weights": "a"}
    write_json(file, {"request": request, **asdict(evaluation([1, 0, 1]))})
    assert read_evaluation(file, request) == evaluation([1, 0, 1])
    assert read_evaluation(file, {**request, "weights": "b"}) is None
    short = asdict(evaluation([1, 0]))
    write_json(file, {"request": request, **short})
    assert read_evaluation(file, request) is None
    file.write_text(file.read_text()[:50])
    assert read_evaluation(file, request) is None
    assert read_evaluation(tmp_path / "absent.json", request) is None


def test_the_best_checkpoint_has_the_highest_measure_then_reward_then_step():
    curve = {10: evaluation([1, 0]), 20: evaluation([1, 1]), 30: evaluation([0, 0])}
    assert best_step(curve, "success") == 20
    better_reward = Evaluation([True, False], [0.6, 0.6], [0, 1])
    assert best_step({10: better_reward, 20: evaluation([1, 0])}, "success") == 10
    assert best_step({10: evaluation([1, 0]), 20: evaluation([0, 1])}, "success") == 20
    assert (
        best_step({10: better_reward, 20: Evaluation([True, True], [0.1, 0.1], [0, 1])}, "max_reward") == 10
    )


# ---- results and report ----


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
            "rounds": list(rounds),
            "seconds": seconds or {"total": 50.0},
            "starts": [{"rounds_adopted": adopted, "git": None, "versions": {"torch": "2"}}],
            "evaluated_with": {"git": None, "versions": {"torch": torch}},
        },
    )


def collected(guided, unguided, actions=None, states=None) -> dict:
    """A round's report; generated, successful and kept episodes of both parts, none of them trivial."""
    keys = ("generated", "successful", "kept")
    parts = [dict(zip(keys, part, strict=True)) for part in (guided, unguided)]
    return {
        **{key: parts[0][key] + parts[1][key] for key in keys},
        "guided": {"trivial": 0, **parts[0]},
        "unguided": {"trivial": 0, **parts[1]},
        "mean_shift_in_sigmas": 0.5,
        "diagnostics": {"actions": actions, "states": states} if actions or states else None,
        "seconds": {"teacher": 2.0, "environment": 1.0},
    }


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
    round_ = collected(guided=(6, 6, 5), unguided=(4, 2, 2))
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
    difference = compare(results["agpd"], results["bc"], "best", "success")
    # differences [[0, 1, 1, 0], [0, 0, 1, 1]]: equal row means, so MS_seed = 0 is replaced by MS_rest;
    # column means 0, .5, 1, .5 about .5: MS_environment = 2 * .5 / 3 = 1/3; residuals 0, +-.5, 0, +-.5: MS_rest = 1/3
    half = t.ppf(0.975, 1) * np.sqrt(1 / 3 / 8)
    assert difference.mean == 0.5 and difference.n_seeds == 2
    assert (difference.low, difference.high) == pytest.approx((0.5 - half, 0.5 + half))
    against_teacher = compare(results["agpd"], results["teacher"], "last", "success")
    assert against_teacher.mean == pytest.approx((2 / 4 + 3 / 4) / 2 - 3 / 4) and against_teacher.n_seeds == 2
    assert compare(results["teacher"], results["bc"], "last", "max_reward").mean == pytest.approx(
        0.5 * (0.75 - 0.125)
    )
    assert compare(results["bc"][:1], results["agpd"][1:], "best", "success") is None


def test_a_row_of_the_table(compared):
    _, results = compared
    row = method_row("agpd", results["agpd"])
    assert row[:2] == ("agpd", "20")
    assert row[2].startswith("0.88 [") and row[3].startswith("0.62 [") and row[4] == "0.50 / 0.75"
    assert row[7] == "8", "two training seeds of four environments"
    assert row[8] == "15 / 12 / 10", "means per training seed"
    assert row[9] == training_time(results["agpd"]) == "60 s: environment 10, teacher 20, training 30"
    assert row[10:] == ("1.50 M", "2.0")
    teacher = method_row("teacher", results["teacher"])
    assert (teacher[1], teacher[2], teacher[8], teacher[9]) == ("-", "-", "-", "-")


def test_collection_rounds_are_pooled_and_averaged(compared):
    _, results = compared
    run = replace(
        results["agpd"][0],
        rounds=[
            collected((8, 6, 6), (2, 1, 1), {"rms_to_teacher": 0.1}, {"entropy": -1.0, "coverage": None}),
            collected((8, 2, 2), (0, 0, 0), {"rms_to_teacher": 0.3}, {"entropy": -2.0, "coverage": 0.5}),
        ],
    )
    rows = collection_rows({"bc": results["bc"], "agpd": [run]})
    assert rows == [
        ("agpd", "0.50", "0.50", "0.50", "0.200", "-", "-", "-", "-1.50", "0.50", "3"),
    ], "8 of 16 guided, 1 of 2 unguided; nothing of a method without rounds"
    assert len(rows[0]) == len(HEADER)


def test_the_report_says_what_is_missing_and_what_was_disturbed(compared):
    matrix, results = compared
    text = report(matrix, {"pusht": results}, ["pusht/dagger/seed-1"])
    assert "## pusht" in text and "Not finished: pusht/dagger/seed-1" in text
    assert "`agpd`: the whole method" in text and "pusht/agpd/seed-2 (1)" in text
    assert "same code" not in text
    assert "| agpd | +0.50 [" in text and "4 other environments (seeds from 100000)" in text


def test_the_report_says_if_the_code_changed_on_the_way(compared):
    matrix, results = compared
    run = results["bc"][0].run
    store(run, matrix, [1, 0, 0, 0], [0, 0, 0, 0], {10: [1, 1], 20: [1, 0]}, torch="3")
    results["bc"][0] = read_result(run, matrix)
    text = report(matrix, {"pusht": results}, [])
    assert "Not all was made with the same code: torch 2; torch 3.**" in text


def test_differences_without_spread_are_not_shown_as_certain(compared):
    _, results = compared
    rows = difference_rows({"a": results["bc"], "b": results["bc"]}, "last", "success")
    assert rows == [("a", "", "+0.00 (in every pair)"), ("b", "+0.00 (in every pair)", "")]


def test_curves_are_means_over_training_seeds(compared, tmp_path):
    _, results = compared
    steps, values = mean_curve(results["bc"], "success")
    assert steps.tolist() == [10, 20] and values.tolist() == [[1, 0.5], [0, 1]]
    draw_curves(results, "success", "a task", tmp_path / "curves.png")
    assert (tmp_path / "curves.png").read_bytes()[:4] == b"\x89PNG"


def test_a_result_is_trusted_only_if_whole_and_of_this_matrix(compared, tmp_path):
    matrix, results = compared
    run = results["bc"][0].run
    matrix.evaluation.episodes = 5
    with pytest.raises(ValueError, match="other evaluation than the matrix has now"):
        read_result(run, matrix)
    path = run.folder / RESULT
    text = path.read_text()
    path.write_text(text[: len(text) // 2])
    with pytest.raises(ValueError, match=r"run\.json is damaged .* remove it"):
        read_result(run, matrix)
    path.unlink()
    assert read_result(run, matrix) is None


def test_json_is_replaced_in_one_go(tmp_path):
    path = tmp_path / "x.json"
    write_json(path, {"a": 1})
    with pytest.raises(ValueError, match="Circular"):
        loop: dict = {}
        loop["loop"] = loop
        write_json(path, loop)
    assert read_json(path) == {"a": 1} and [entry.name for entry in tmp_path.iterdir()] == ["x.json"]
