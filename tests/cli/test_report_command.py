"""`lerobot-agpd-report` on real Push-T."""

import json
import shutil
import sys
from contextlib import closing

import pytest
import torch
from huggingface_hub import ModelCard
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import PushtEnv
from lerobot.policies import make_pre_post_processors

from lerobot_agpd.cards.model_card import ModelFacts, model_card
from lerobot_agpd.cli import report as command
from lerobot_agpd.flag_checks import FlagError
from lerobot_agpd.policies.agpd.configuration_agpd import AGPDConfig
from lerobot_agpd.policies.agpd.modeling_agpd import AGPDPolicy
from lerobot_agpd.policies.agpd_diffusion.modeling_agpd_diffusion import AGPDDiffusionPolicy
from lerobot_agpd.studies.evaluation import Evaluator

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
        "report.html",
        "report.json",
        "report.md",
        "curves.png",
        "evaluations",
    }
    assert "1 step per chunk" in (tmp_path / "several" / "report.md").read_text()


@pytest.mark.parametrize(("n_action_steps", "predictions"), [(None, 3), (4, 3), (2, 6), (1, 12)])
def test_the_policy_predicts_as_often_as_asked(monkeypatch, tmp_path, student, n_action_steps, predictions):
    """In an episode of 12 steps."""
    calls, predict = [], AGPDPolicy.predict_action_chunk
    monkeypatch.setattr(
        AGPDPolicy, "predict_action_chunk", lambda self, batch: calls.append(1) or predict(self, batch)
    )
    config = PushtEnv(obs_type="environment_state_agent_pos", episode_length=12)
    with closing(Evaluator(config, 1, tmp_path, "cpu")) as evaluator:
        evaluator.evaluate(student, 1, 100_000, n_action_steps)
    assert len(calls) == predictions


def test_nothing_to_report_and_missing_folders_are_named(tmp_path):
    with pytest.raises(FlagError, match="--runs='{name: folder}'"):
        command.ReportConfig(env=PushtEnv(), output=tmp_path)
    with pytest.raises(FileNotFoundError, match="'a': .*missing does not exist"):
        command.ReportConfig(env=PushtEnv(), output=tmp_path, policies={"a": tmp_path / "missing"})


@pytest.mark.parametrize(
    ("options", "flag"),
    [
        ({"episodes": 1}, "--episodes must be at least 2"),
        ({"curve_episodes": 1}, "--curve_episodes must be 0 or at least 2"),
        ({"batch_size": 0}, "--batch_size"),
        ({"seed": 1000}, "--seed=1000: .*training and collection never use"),
        ({"n_action_steps": [4, 5]}, "n_action_steps=5: .* was trained to execute 4"),
        ({"n_action_steps": [0]}, "n_action_steps=0: .* was trained to execute 4"),
    ],
)
def test_what_cannot_work_is_refused_before_anything_is_evaluated(tmp_path, student, options, flag):
    with pytest.raises(FlagError, match=flag):
        command.ReportConfig(env=PushtEnv(), output=tmp_path, policies={"a": student}, **options)


def test_a_policy_that_samples_does_so_reproducibly(tmp_path, agpd_diffusion_config):
    """Twice the same episodes, whatever was drawn before."""
    inputs = {
        "observation.state": PolicyFeature(FeatureType.STATE, (2,)),
        "observation.environment_state": PolicyFeature(FeatureType.ENV, (16,)),
    }
    config = agpd_diffusion_config(input_features=inputs)
    AGPDDiffusionPolicy(config).save_pretrained(tmp_path)
    stats = {
        key: {"min": torch.zeros(size), "max": torch.full((size,), 512.0)}
        for key, size in (("observation.state", 2), ("observation.environment_state", 16), ("action", 2))
    }
    for processor in make_pre_post_processors(config, dataset_stats=stats):
        processor.save_pretrained(tmp_path)
    env = PushtEnv(obs_type="environment_state_agent_pos", episode_length=12)
    evaluations = []
    for folder in ("a", "b"):
        torch.rand(3)
        with closing(Evaluator(env, 2, tmp_path / folder, "cpu")) as evaluator:
            evaluations.append(evaluator.evaluate(tmp_path, 2, 100_000))
    assert evaluations[0] == evaluations[1]


def test_finished_evaluations_are_written_before_one_fails(monkeypatch, tmp_path, student):
    done = []

    def second_fails(name, *rest):
        if done:
            raise ValueError("the second one")
        done.append(name)
        return evaluate_policy(name, *rest)

    evaluate_policy = command.report_policy
    monkeypatch.setattr(command, "report_policy", second_fails)
    with pytest.raises(SystemExit, match="the second one"):
        reported(monkeypatch, tmp_path / "out", f"--policies={{a: {student}, b: {student}}}")
    assert [row["name"] for row in json.loads((tmp_path / "out" / "report.json").read_text())["methods"]] == [
        "a"
    ]


def test_a_second_report_reuses_the_evaluations(monkeypatch, tmp_path, student):
    policies = f"--policies={{student: {student}}}"
    rows = reported(monkeypatch, tmp_path / "out", policies)

    def refuse(self, *arguments):
        raise AssertionError("evaluated again")

    monkeypatch.setattr(Evaluator, "_roll_out", refuse)
    again = reported(monkeypatch, tmp_path / "out", policies)
    assert again["student"]["final"] == rows["student"]["final"]
    with pytest.raises(AssertionError, match="evaluated again"):
        reported(monkeypatch, tmp_path / "out", policies, "--seed=100007")


def test_a_run_is_reported_with_its_curve(monkeypatch, tmp_path, student):
    """A folder of lerobot-train with two checkpoints, here of the same weights."""
    run = student.parents[2]
    shutil.copytree(student, run / "checkpoints" / "000005" / "pretrained_model")
    rows = reported(monkeypatch, tmp_path / "out", f"--runs={{run: {run}}}", "--curve_episodes=2")
    curve = rows["run"]["curve"]
    assert list(curve) == ["5", "10"] and curve["10"] == rows["run"]["final"]
    assert curve["5"]["seeds"] == [100_000, 100_001]


def test_the_success_rate_enters_the_model_card(monkeypatch, tmp_path, student):
    model_card(AGPDConfig(push_to_hub=False), ModelFacts("A student.", {}, "local/demos")).save(
        student / "README.md"
    )
    rows = reported(monkeypatch, tmp_path / "out", f"--policies={{student: {student}}}")
    card = ModelCard.load(student / "README.md")
    assert card.data.eval_results[0].metric_value == rows["student"]["success"]["mean"]
    assert "3 episodes, seeds from 100000" in card.text
