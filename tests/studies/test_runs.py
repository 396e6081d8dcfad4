"""The matrix, its runs, and their folders."""

import json
import sys
from pathlib import Path

import draccus
import pytest
from lerobot.configs import PreTrainedConfig
from lerobot.datasets.utils import STATS_PATH
from matrices import MISSING, changed, content, load

from lerobot_agpd.flag_checks import FlagError
from lerobot_agpd.studies.matrix import flat, load_matrix
from lerobot_agpd.studies.parsing import decode_environment, parse_train_flags
from lerobot_agpd.studies.provenance import digest
from lerobot_agpd.studies.runs import check, expand
from lerobot_agpd.studies.training import (
    check_same_command,
    is_trained,
    last_checkpoint,
    last_step,
    noted_start,
    prepare,
    read_starts,
    train_command,
)

pytest.importorskip("lerobot_policy_agpd")  # registers the policy and environment types

ROOT = Path(__file__).parents[2]

sys.path.append(str(ROOT / "benchmarks"))
from committed import flags as committed_flags  # noqa: E402

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
    assert teacher.seed is None and teacher.flags["policy.path"] == teacher.policy
    args = bc.args
    assert "--dataset.episodes=[0, 1]" in args and "--policy.push_to_hub=false" in args and "--seed=1" in args
    check(matrix, runs)


def test_a_part_of_the_matrix(tmp_path):
    matrix = load(tmp_path, content(tmp_path))
    assert [run.name for run in expand(matrix, ["pusht"], ["agpd"], [2])] == ["pusht/agpd/seed-2"]
    for part, flag in (
        (([], ["ppo"], []), "methods"),
        ((["lift"], [], []), "tasks"),
        (([], [], [9]), "seeds"),
    ):
        with pytest.raises(FlagError, match=f"--{flag}: the matrix has no .* there are"):
            expand(matrix, *part)


@pytest.mark.parametrize(
    ("where", "value", "message"),
    [
        ("sedes", [1], "sedes"),
        ("tasks.pusht.flag", {}, "tasks.pusht.*flag"),
        ("tasks.pusht.measure", "reward", "tasks.pusht.*measure.*reward"),
        ("tasks.pusht.env", {"obs_type": "x"}, "env needs a type"),
        ("tasks.pusht.teacher", "", "method 'agpd' takes a teacher and tasks.pusht names none"),
        ("methods.agpd", {"policy": "x", "flags": {"steps": 1}}, "only evaluated"),
        ("methods.agpd.flags", {"seed": 3}, "methods.agpd.flags sets 'seed'"),
        ("common.output_dir", "x", "common sets 'output_dir'"),
        ("seeds", [1, 1], "different training seeds"),
        ("seeds", ["a"], "seeds.*'a'"),
        ("seeds", 3, "seeds.*3"),
        ("seeds", [100_000], r"training seeds lie in \[0, 100000\)"),
        ("output", MISSING, "output"),
        ("common", [1], "common"),
        ("references", ["dc"], r"references \['dc'\] are no methods"),
        ("references", "bc", "references.*bc"),
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


PARSED: set[str] = set()
"""Methods' flags that a matrix has shown to exist: parsing takes seconds, and matrices share most methods."""


def changed_defaults(matrix: str, run, config):
    """Options of the policy with which a committed run was made, and what its flags mean today, where they differ."""
    results = ROOT / "benchmarks" / "comparison" / "results" / matrix
    made = results / run.task / run.method / f"seed-{run.seed}" / "run.json"
    if not made.is_file():
        return
    then = committed_flags(flat({"policy": json.loads(made.read_text())["config"]["policy"]}))
    now = flat({"policy": draccus.encode(config.policy, PreTrainedConfig)})
    guides = run.flags.get("policy.collect.every") != 0 and config.policy.collect.guides
    of_its_own = ("path", "root", "input_features", "output_features", "env", "device", "pretrained_path")
    for name in then.keys() & now.keys():
        if name.startswith("policy.guidance.") and not guides:
            continue  # had another default, which decides nothing there
        if not set(name.split(".")) & set(of_its_own) and then[name] != now[name]:
            yield name, (then[name], now[name])


@pytest.mark.slow
@pytest.mark.parametrize(
    "path", sorted((ROOT / "benchmarks" / "comparison").glob("*.yaml")), ids=lambda p: p.stem
)
def test_the_flags_of_committed_matrices_exist(path, monkeypatch, tmp_path):
    monkeypatch.setenv("AGPD_RUNS", str(tmp_path))
    monkeypatch.chdir(ROOT)
    matrix = load_matrix(path)
    tasks, methods, seeds = list(matrix.tasks), list(matrix.methods), matrix.seeds[:1]
    every_method = expand(matrix, tasks=tasks[:1], seeds=seeds)
    every_task = expand(matrix, tasks=tasks[1:], methods=methods[:1], seeds=seeds) if tasks[1:] else []
    for run in every_method + every_task:
        decode_environment(matrix.tasks[run.task].env)
        flags = str(matrix.methods[run.method].flags)
        if not run.policy and (run in every_task or flags not in PARSED):
            PARSED.add(flags)
            config = parse_train_flags(run.args)
            changed = dict(changed_defaults(path.stem, run, config))
            assert not changed, (
                f"{run.name} was made with other defaults: pin them in {path.name}, or run it again"
            )


# ---- what a folder says ----


def checkpoint(run, step: int, steps: int, rounds: int = 0) -> None:
    """What is read of a LeRobot checkpoint."""
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
    assert train_command(one_run) == ["lerobot-train", *one_run.args, f"--output_dir={one_run.output_dir}"]
    checkpoint(one_run, 10, 20)
    (one_run.output_dir / "checkpoints" / "000015").mkdir()  # killed while saving: not linked, not trusted
    prepare(one_run)
    assert last_step(one_run) == 10 and not is_trained(one_run)
    last = one_run.output_dir / "checkpoints" / "last" / "pretrained_model" / "train_config.json"
    assert train_command(one_run)[1:] == [
        f"--config_path={last}",
        "--resume=true",
        f"--output_dir={one_run.output_dir}",
    ]
    checkpoint(one_run, 20, 20)
    assert is_trained(one_run)


def test_without_a_checkpoint_a_run_starts_anew(one_run):
    (one_run.output_dir / "checkpoints" / "000010").mkdir(parents=True)
    prepare(one_run)
    assert not one_run.output_dir.exists() and last_checkpoint(one_run) is None and last_step(one_run) == 0


def test_other_flags_are_refused(one_run, tmp_path):
    prepare(one_run)
    check_same_command(one_run)
    with noted_start(one_run, ["lerobot-train"], threads=1):
        pass
    check_same_command(one_run)
    other = load(tmp_path, changed(content(tmp_path), "methods.agpd.flags", {"batch_size": 3}))
    with pytest.raises(FlagError, match="started with other flags .batch_size: - -> 3"):
        check_same_command(expand(other, methods=["agpd"], seeds=[1])[0])


def test_a_run_is_not_resumed_with_another_teacher_or_other_demonstrations(one_run, tmp_path):
    teacher, statistics = tmp_path / "teacher" / "model.safetensors", tmp_path / "demos" / STATS_PATH
    statistics.parent.mkdir()
    for file in (teacher, statistics):
        file.write_text("one")
    prepare(one_run)
    with noted_start(one_run, ["lerobot-train"], threads=1):
        pass
    known = read_starts(one_run)[0]["inputs"]
    assert known == {"teacher": digest(tmp_path / "teacher"), "demonstrations": digest(tmp_path / "teacher")}
    check_same_command(one_run)
    for file, kind in ((teacher, "teacher"), (statistics, "demonstrations")):
        file.write_text("another")
        with pytest.raises(FlagError, match=rf"other files than now lie at its paths \({kind}\)"):
            check_same_command(one_run)
        file.write_text("one")
    teacher.write_text("another")
    checkpoint(one_run, 20, 20)
    check_same_command(one_run)  # finished: what it was made with is no longer needed


def test_starts_are_remembered_with_their_time(one_run):
    prepare(one_run)
    killed = noted_start(one_run, ["lerobot-train"], threads=1)
    killed.__enter__()  # and never left
    (one_run.folder / "train.log").write_text("alive")
    checkpoint(one_run, 10, 20, rounds=1)
    with noted_start(one_run, ["lerobot-train", "--resume=true"], threads=2):
        pass
    first, second = read_starts(one_run)
    assert first["interrupted"] and 0 <= first["seconds"] < 60
    assert second["from_step"] == 10 and "interrupted" not in second
    assert first["versions"]["lerobot"] and first["host"]["cores"]
