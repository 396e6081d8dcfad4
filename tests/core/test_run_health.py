"""The health of a run's folder: a healthy one has no fault, and every damage is named with path and remedy."""

import json
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from lerobot.common.train_utils import save_checkpoint, update_last_checkpoint
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig
from point_environment import PointEnv
from safetensors.torch import load_file, save_file

from lerobot_agpd.health.checkpoints import examine_checkpoints
from lerobot_agpd.health.dataset import examine_dataset
from lerobot_agpd.health.finding import Finding, Severity, is_broken
from lerobot_agpd.health.run_folder import examine_run

STEPS = 10


@pytest.fixture(scope="module")
def originals() -> dict[str, Path]:
    """The run, once it was trained; every test damages a copy of it."""
    return {}


@pytest.fixture
def run(originals, start, point_demonstrations, tmp_path) -> Path:
    """A run of two finished rounds, with checkpoints after steps 4 and 7 of 10."""
    if not originals:
        training = start()
        for until in (4, 7):
            training.train(until)
            save(training, point_demonstrations)
        originals["run"] = training.agpd.run.output_dir
        originals["demonstrations"] = Path(point_demonstrations.root)
    folder = tmp_path / "copy" / "run"
    shutil.copytree(originals["run"], folder, symlinks=True)
    return folder


def save(training, dataset) -> None:
    """Save a checkpoint as `lerobot-train` does."""
    output, step = training.agpd.run.output_dir, training.agpd.progress.step
    folder = output / "checkpoints" / f"{step:06d}"
    data = DatasetConfig(dataset.repo_id, root=str(dataset.root))
    config = TrainPipelineConfig(
        policy=training.policy.config, dataset=data, env=PointEnv(), output_dir=output, steps=STEPS
    )
    save_checkpoint(folder, step, config, training.policy, training.optimizer, None, *training.processors)
    update_last_checkpoint(folder)


def faults(findings: list[Finding]) -> list[Finding]:
    return [finding for finding in findings if finding.severity in (Severity.WARNING, Severity.BROKEN)]


def test_a_healthy_run(run):
    findings = examine_run(run)
    assert faults(findings) == []
    areas = {finding.area for finding in findings}
    assert areas == {"checkpoints", "continue", "episodes", "demonstrations", "disk"}
    (episodes,) = [finding.text for finding in findings if finding.area == "episodes"]
    n_kept = sum('"kept": true' in line for path in run.glob("agpd/round-*/*.jsonl") for line in path.open())
    assert f"2 finished rounds, {n_kept} kept episodes; 2 of 2 rounds intact" in episodes
    before = {path: path.stat().st_mtime_ns for path in run.rglob("*")}
    again = [finding for finding in examine_run(run) if finding.area != "disk"]
    assert again == [finding for finding in findings if finding.area != "disk"], "deterministic"
    assert {path: path.stat().st_mtime_ns for path in run.rglob("*")} == before, "nothing is changed"


def test_the_command_that_goes_on(run, originals):
    """Of a copy, LeRobot must be told the folder: it would go on in the original's."""
    for folder, moved in ((originals["run"], []), (run, [f"--output_dir={run}"])):
        checkpoint = examine_checkpoints(folder)[1]
        config = folder / "checkpoints" / "000007" / "pretrained_model" / "train_config.json"
        args = ["lerobot-train", f"--config_path={config}", "--resume=true", *moved]
        assert shlex.split(checkpoint.resume_command) == args and config.is_file()


# ---- damage ----


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def garble(path: Path) -> None:
    lines = path.read_text().splitlines()
    path.write_text("\n".join([lines[0], "{not json", *lines[2:], ""]))


def cut_rows(path: Path) -> None:
    np.save(path, np.load(path)[:-1])


def with_nan(path: Path) -> None:
    if path.suffix == ".npy":
        rows = np.load(path)
        rows["action"][1] = np.nan
        np.save(path, rows)
        return
    tensors = load_file(path)
    tensors[sorted(tensors)[0]].flatten()[0] = torch.nan
    save_file(tensors, path)


def drop_line(path: Path) -> None:
    path.write_text("".join(path.read_text().splitlines(keepends=True)[1:]))


def empty_object(path: Path) -> None:
    path.write_text("{}")


def of_a_list(path: Path) -> None:
    path.write_text("[]")


LAST = "checkpoints/000007/"
DAMAGE = {
    "truncated episode": ("agpd/round-00000/rank-0-*.npy", truncate, "delete the line"),
    "missing episode": ("agpd/round-00001/rank-0-*.npy", Path.unlink, "delete the line"),
    "short episode": ("agpd/round-00001/rank-0-*.npy", cut_rows, "delete the line"),
    "NaN in an episode": ("agpd/round-00000/rank-0-*.npy", with_nan, "delete the line"),
    "damaged index line": ("agpd/round-00000/rank-0.jsonl", garble, "delete the line"),
    "missing index line": ("agpd/round-00000/rank-0.jsonl", drop_line, "restore"),
    "missing report": ("agpd/round-00000/report.json", Path.unlink, "restore it"),
    "truncated report": ("agpd/round-00001/report.json", truncate, "restore it"),
    "foreign report": ("agpd/round-00001/report.json", empty_object, "restore it"),
    "truncated journal": ("agpd/journal.json", truncate, "restore it"),
    "missing journal": ("agpd/journal.json", Path.unlink, "restore it"),
    "missing round": ("agpd/round-00000", shutil.rmtree, "restore it"),
    "truncated weights": (LAST + "pretrained_model/model.safetensors", truncate, "restore the file"),
    "missing weights": (LAST + "pretrained_model/model.safetensors", Path.unlink, "restore the file"),
    "NaN weights": (LAST + "pretrained_model/model.safetensors", with_nan, "earlier checkpoint"),
    "truncated config": (LAST + "pretrained_model/config.json", truncate, "restore the file"),
    "truncated training config": (LAST + "pretrained_model/train_config.json", truncate, "restore the file"),
    "foreign processors": (LAST + "pretrained_model/policy_preprocessor.json", of_a_list, "restore the file"),
    "truncated statistics": (LAST + "pretrained_model/*_normalizer_*.safetensors", truncate, "restore"),
    "missing optimizer": (LAST + "training_state/optimizer_state.safetensors", Path.unlink, "restore"),
    "truncated counters": (LAST + "pretrained_model/agpd_state.json", truncate, "restore the file"),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_damage_is_named_with_path_and_remedy(run, name):
    pattern, damage, remedy = DAMAGE[name]
    path = sorted(run.glob(pattern))[0]
    damage(path)
    named = path.with_name("report.json") if name == "missing index line" else path
    broken = [finding for finding in examine_run(run) if finding.severity is Severity.BROKEN]
    (found,) = [finding for finding in broken if str(named) in finding.text]
    assert remedy in found.remedy
    assert "\n" not in found.text + found.remedy


@pytest.mark.parametrize("kind", ["weights", "episodes"])
def test_the_newest_checkpoint_that_can_be_read_goes_on(run, kind):
    if kind == "weights":
        truncate(run / LAST / "pretrained_model" / "model.safetensors")
    findings, checkpoint = examine_checkpoints(run)
    assert checkpoint.step == (4 if kind == "weights" else 7)
    (hint,) = [finding.remedy for finding in findings if finding.area == "continue"]
    assert f"{checkpoint.step:06d}" in hint
    links = [finding for finding in faults(findings) if "the link" in finding.text]
    assert len(links) == (kind == "weights")


@pytest.mark.parametrize("state", ["missing", "leads nowhere", "leads to 000004"])
def test_the_link_to_the_last_checkpoint(run, state):
    link = run / "checkpoints" / "last"
    link.unlink()
    if state != "missing":
        link.symlink_to("000004" if state.endswith("4") else "000009")
    (found,) = faults(examine_run(run))
    assert state in found.text and shlex.split(found.remedy) == ["ln", "-sfn", "000007", str(link)]


def test_a_complete_run_says_so(run):
    config = run / LAST / "pretrained_model" / "train_config.json"
    config.write_text(config.read_text().replace(f'"steps": {STEPS}', '"steps": 7'))
    (found,) = [finding for finding in examine_run(run) if finding.area == "continue"]
    assert "complete (7 of 7 steps)" in found.text and found.remedy.endswith("--steps=<more>")


def test_rounds_that_a_checkpoint_has_used(run):
    shutil.rmtree(run / "agpd" / "round-00001")
    (found,) = faults(examine_run(run))
    assert "has used 2 rounds" in found.text and "--policy.replay.root" in found.remedy
    shutil.rmtree(run / "agpd")
    (found,) = [finding for finding in faults(examine_run(run)) if finding.area == "episodes"]
    assert f"{run / 'agpd'} is missing; the run goes on with the episodes in" in found.text


def test_an_unfinished_round_and_leftovers_are_no_fault(run):
    (run / "agpd" / "round-00001" / "report.json").unlink()
    for checkpoint in run.glob("checkpoints/00*"):
        counters = checkpoint / "pretrained_model" / "agpd_state.json"
        counters.write_text(json.dumps({**json.loads(counters.read_text()), "rounds": 1}))
    (run / "agpd" / "round-00001" / "rank-0-000099.npy.partial").touch()
    (run / "agpd" / "round-00001" / "rank-0-000098.npy").touch()
    findings = examine_run(run)
    assert faults(findings) == []
    notes = [finding.text for finding in findings if finding.severity is Severity.NOTE]
    assert len(notes) == 2 and "round-00001 is not finished" in notes[0] and "2 files" in notes[1]


def test_what_a_run_needs_is_not_there_any_more(run):
    for config in run.glob("checkpoints/00*/pretrained_model/train_config.json"):
        content = json.loads(config.read_text())
        content["dataset"]["root"] = str(run / "moved")
        config.write_text(json.dumps(content))
    (found,) = faults(examine_run(run))
    assert found.severity is Severity.BROKEN and f"--dataset.root={run / 'moved'}" in found.text


def test_a_folder_without_checkpoints(tmp_path):
    findings = examine_run(tmp_path)
    (found,) = faults(findings)
    assert "holds no checkpoint yet" in found.text and not is_broken(findings)


# ---- demonstrations ----


@pytest.fixture
def dataset(run, originals, tmp_path) -> Path:
    return shutil.copytree(originals["demonstrations"], tmp_path / "demonstrations")


def test_a_healthy_dataset(dataset):
    (found,) = examine_dataset(dataset)
    assert found.severity is Severity.OK and "3 episodes" in found.text


@pytest.mark.parametrize("damage", [truncate, Path.unlink])
@pytest.mark.parametrize(
    "pattern", ["meta/info.json", "meta/stats.json", "meta/tasks.parquet", "meta/episodes/*/*", "data/*/*"]
)
def test_a_damaged_dataset(dataset, pattern, damage):
    (path,) = dataset.glob(pattern)
    damage(path)
    findings = examine_dataset(dataset)
    assert is_broken(findings)
    named = [str(path), str(path.parents[1])]  # files that are missing are missed in their folder
    assert any(name in finding.text for name in named for finding in findings)
    assert all(finding.remedy and "\n" not in finding.text for finding in findings)
