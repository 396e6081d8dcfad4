"""What a run's command line says that a policy is never told."""

import sys

import pytest
from lerobot.configs.train import TrainPipelineConfig

from lerobot_agpd.run import RunInfo, declared_run, this_run


@pytest.fixture
def said(monkeypatch, tmp_path):
    """Facts of a run with these words on its command line."""

    def facts(*words: str) -> RunInfo:
        monkeypatch.setattr(sys, "argv", ["lerobot-train", *words])
        return this_run()

    return facts


def test_steps(said, tmp_path):
    file = tmp_path / "preset.yaml"
    file.write_text("steps: 300\n")
    assert said("--steps=7", f"--config_path={file}").steps == 7, "the command line comes first"
    assert said(f"--config_path={file}").steps == 300


def test_a_run_without_steps_ends_where_lerobot_ends_it(said):
    default = TrainPipelineConfig.__dataclass_fields__["steps"].default
    assert said("--policy.type=agpd").steps == default > 0


def test_output_folder_and_resume(said, tmp_path):
    facts = said("--output_dir=outputs/x", "--resume=true")
    assert str(facts.output_dir) == "outputs/x" and facts.resume
    assert said() == RunInfo(steps=said().steps), "nothing was said"


def test_a_declared_run_is_not_asked_for_its_command_line(said):
    with declared_run(RunInfo(steps=3)):
        assert said("--steps=7").steps == 3
