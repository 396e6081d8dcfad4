"""`lerobot-agpd-report` on real Push-T."""

import json
import sys

import pytest
from lerobot.envs.configs import PushtEnv

from lerobot_agpd.analysis.evaluation import Checkpoint, Environments
from lerobot_agpd.cli import report as command

pytest.importorskip("gym_pusht")


def reported(monkeypatch, output, *flags):
    env = ["--env.type=pusht", "--env.obs_type=environment_state_agent_pos", "--env.episode_length=12"]
    argv = [
        "lerobot-agpd-report",
        *env,
        f"--output={output}",
        "--episodes=3",
        "--batch_size=2",
        "--curve_episodes=0",
        *flags,
    ]
    monkeypatch.setattr(sys, "argv", argv)
    command.main()
    return {row["name"]: row for row in json.loads((output / "report.json").read_text())["methods"]}


def test_one_row_per_policy_and_number_of_executed_steps(monkeypatch, tmp_path, student, capsys):
    policies = f"--policies={{student: {student}}}"
    plain = reported(monkeypatch, tmp_path / "plain", policies)
    rows = reported(monkeypatch, tmp_path / "several", policies, "--n_action_steps=[4,1]")
    assert list(rows) == ["student, 4 steps per chunk", "student, 1 step per chunk"]
    own, every = rows.values()
    assert own["final"] == plain["student"]["final"]
    assert every["final"]["seeds"] == [100_000, 100_001, 100_002]
    assert {path.name for path in (tmp_path / "several").iterdir()} == {
        "report.json",
        "report.md",
        "curves.png",
    }
    assert "1 step per chunk" in (tmp_path / "several" / "report.md").read_text()


@pytest.mark.parametrize(("n_action_steps", "predictions"), [(None, 3), (4, 3), (2, 6), (1, 12)])
def test_the_policy_predicts_as_often_as_asked(student, n_action_steps, predictions):
    """In an episode of 12 steps."""
    checkpoint, calls = Checkpoint(student, "cpu", n_action_steps), []
    checkpoint.policy.model.register_forward_hook(lambda *_: calls.append(1))
    config = PushtEnv(obs_type="environment_state_agent_pos", episode_length=12)
    with Environments(config, n_envs=1) as environments:
        checkpoint.evaluate(environments, 1, 100_000)
    assert len(calls) == predictions


@pytest.mark.parametrize("n_action_steps", [0, 5])
def test_impossible_numbers_of_executed_steps_are_refused(student, n_action_steps):
    with pytest.raises(ValueError, match=f"n_action_steps={n_action_steps}: .* was trained to execute 4"):
        Checkpoint(student, "cpu", n_action_steps)


def test_nothing_to_report_and_missing_folders_are_named(tmp_path):
    with pytest.raises(ValueError, match="--runs='{name: folder}'"):
        command.ReportConfig(env=PushtEnv(), output=tmp_path)
    with pytest.raises(FileNotFoundError, match="'a': .*missing does not exist"):
        command.ReportConfig(env=PushtEnv(), output=tmp_path, policies={"a": tmp_path / "missing"})
