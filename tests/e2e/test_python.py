"""`train(config)` from Python, as in examples/train_fetchreach.py, does what the command does."""

import json
import runpy
import shutil
import sys
from pathlib import Path

import pytest
from commands import EXAMPLES, last_checkpoint, records, reports
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.scripts.lerobot_train import train

from lerobot_agpd.config import CollectConfig, TeacherConfig
from lerobot_agpd.envs.gymnasium_robotics import GymnasiumRoboticsEnv
from lerobot_agpd.health.finding import Severity
from lerobot_agpd.health.run_folder import examine_run
from lerobot_agpd.policies.agpd.configuration_agpd import AGPDConfig

pytestmark = pytest.mark.slow

UNRELATED = [
    "pytest",
    "--env.type=pusht",
    "--steps=3",
    "--output_dir=elsewhere",
    "--policy.collect.episodes=1",
]
"""What a program that calls `train` may have on its own command line."""


@pytest.fixture(scope="module")
def example(tmp_path_factory) -> Path:
    """The folder in which the example ran."""
    folder = tmp_path_factory.mktemp("example")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr(sys, "argv", UNRELATED)
        runpy.run_path(str(EXAMPLES / "train_fetchreach.py"), run_name="__main__")
    return folder


def header(output: Path) -> dict:
    return json.loads((output / "agpd" / "journal.json").read_text())


def test_the_example_distills(example: Path) -> None:
    output = example / "outputs" / "fetchreach" / "student"
    assert (last_checkpoint(output) / "model.safetensors").is_file()
    rounds = reports(output)
    assert [report["total"]["generated"] for report in rounds] == [10, 10]
    kept = sum(report["total"]["kept"] for report in rounds)
    assert LeRobotDataset("x", root=output / "agpd" / "merged").num_episodes == kept > 0
    environment = {"type": "gymnasium_robotics", "task": "FetchReach-v4"}
    assert header(output)["identity"]["environment"] == environment
    assert not (example / "elsewhere").exists()


def test_a_finished_run_is_healthy(example: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(example)  # the configuration holds relative paths
    findings = examine_run(Path("outputs/fetchreach/student"))
    assert {finding.severity for finding in findings} == {Severity.OK}
    assert {finding.area for finding in findings} >= {"checkpoints", "continue", "episodes", "demonstrations"}


def test_episodes_go_to_lerobots_default_folder(
    example: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without `output_dir`, LeRobot names a folder after the time."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", UNRELATED)
    outputs = example / "outputs" / "fetchreach"
    student = AGPDConfig(
        teacher=TeacherConfig(path=str(last_checkpoint(outputs / "teacher"))),
        collect=CollectConfig(warmup=1, every=1, rounds=1, episodes=2, diagnostics=False),
        device="cpu",
        push_to_hub=False,
        dim_model=32,
    )
    config = TrainPipelineConfig(
        policy=student,
        dataset=DatasetConfig("local/fetchreach", root=str(outputs / "demonstrations")),
        env=GymnasiumRoboticsEnv(task="FetchReach-v4"),
        batch_size=4,
        num_workers=0,
        env_eval_freq=0,
        steps=3,
    )
    train(config)
    (output,) = (tmp_path / "outputs" / "train").glob("*/*")
    assert [report["total"]["generated"] for report in reports(output)] == [2]
    assert header(output)["identity"]["environment"]["task"] == "FetchReach-v4"
    assert last_checkpoint(output).is_dir()


def test_resuming_from_python(example: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """LeRobot resumes the checkpoint that `--config_path` names in `sys.argv`, and nothing without it."""
    output = tmp_path / "run"
    shutil.copytree(example / "outputs" / "fetchreach" / "student", output, symlinks=True)
    monkeypatch.chdir(example)  # the configuration holds relative paths
    collected = [records(output, number) for number in range(2)]
    checkpoint = last_checkpoint(output)

    def resumed() -> TrainPipelineConfig:
        config = TrainPipelineConfig.from_pretrained(checkpoint)
        config.resume, config.output_dir = True, output
        config.steps += 2
        config.policy.collect = CollectConfig(
            warmup=1, every=100, episodes=2
        )  # the third round after step 201
        return config

    monkeypatch.setattr(sys, "argv", UNRELATED)
    with pytest.raises(ValueError, match="config_path"):
        train(resumed())
    monkeypatch.setattr(sys, "argv", [*UNRELATED, f"--config_path={checkpoint}"])
    config = resumed()
    train(config)
    state = json.loads((last_checkpoint(output) / "agpd_state.json").read_text())
    assert (state["step"], state["rounds"]) == (config.steps, 3)
    assert [records(output, number) for number in range(2)] == collected
    assert [report["total"]["generated"] for report in reports(output)] == [10, 10, 2]
