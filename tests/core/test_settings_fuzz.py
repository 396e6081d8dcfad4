"""Settings that make no sense: whatever the flag, the message names it."""

import sys

import draccus
import pytest
import yaml
from draccus.utils import ParsingError
from lerobot.configs import PreTrainedConfig, parser
from lerobot.configs.train import TrainPipelineConfig
from wrong_settings import GROUPS, all_wrong_settings, of_wrong_types, out_of_range

import lerobot_agpd.plugin  # noqa: F401  # registers the types
from lerobot_agpd.policies.agpd.configuration_agpd import AGPDConfig


def refusal(policy_class, setting) -> str:
    """What draccus' decoder says; building the whole command line takes a second for every setting."""
    path, value = setting.split("=")
    options = yaml.safe_load(value)
    for name in reversed(path.split(".")):
        options = {name: options}
    with pytest.raises(ParsingError) as error:
        draccus.decode(policy_class, {"device": "cpu", **options})
    return str(error.value)


def test_the_command_line_says_the_same():
    setting = "collect.min_reward=nan"
    with pytest.raises(ParsingError) as error:
        draccus.parse(AGPDConfig, args=["--device=cpu", f"--{setting}"])
    assert str(error.value) == refusal(AGPDConfig, setting)


def test_there_are_many_of_them():
    groups = {setting.split(".")[0] for policy_type, setting in of_wrong_types() if policy_type == "agpd"}
    assert len(set(all_wrong_settings())) >= 200 and groups == GROUPS


@pytest.mark.parametrize(("policy_type", "setting"), of_wrong_types())
def test_a_setting_that_makes_no_sense_is_named(policy_type, setting):
    policy_class = PreTrainedConfig.get_choice_class(policy_type)
    assert setting.split("=")[0].rsplit(".", 1)[-1] in refusal(policy_class, setting)


@pytest.mark.parametrize(("policy_type", "setting"), out_of_range())
def test_a_value_beyond_a_limit_is_named_with_flag_and_value(policy_type, setting):
    flag, value = setting.split("=")
    message = refusal(PreTrainedConfig.get_choice_class(policy_type), setting)
    number = yaml.safe_load(value)
    shown = {value, str(float(number))} if isinstance(number, int | float) else {value}
    assert f"--policy.{flag}" in message and any(text in message for text in shown)


# ---- through the real parser ----


@parser.wrap()
def received(config: TrainPipelineConfig) -> None:
    """What `lerobot-train` does until it has its configuration."""


COMMANDS = {  # a setting: what the line says beside the flag's name
    "policy.guidance.scale=-1": ["--policy.guidance.scale must not be negative, got -1"],
    "policy.collect.min_reward=nan": ["--policy.collect.min_reward must be a finite number, got nan"],
    "policy.collect.episodes=some": ["collect.episodes", "'some'", "int"],
    "policy.collect.diagnostics=perhaps": ["collect.diagnostics", "'perhaps'", "bool"],
    "policy.collect.strategy=best": ["--policy.collect.strategy", "'best'", "guided", "mixing"],
    "policy.collect.repo_id=a/b/c": ["--policy.collect.repo_id='a/b/c'", "namespace/repo_name"],
    "policy.collect.nowhere=1": ["--policy.collect.nowhere=1"],
    "policy.scheduler_name=nope": ["--policy.scheduler_name must be one of", "cosine", "'nope'"],
    "env.fps=often": ["fps", "'often'", "int"],
}


@pytest.mark.slow
@pytest.mark.parametrize("setting", COMMANDS)
def test_one_line_of_lerobot_train_names_flag_value_and_what_is_right(setting, monkeypatch, capfd):
    command = ["--policy.type=agpd", "--policy.device=cpu", "--dataset.repo_id=local/x", "--env.type=pusht"]
    monkeypatch.setattr(sys, "argv", ["lerobot-train", *command, f"--{setting}"])
    with pytest.raises(SystemExit) as refused:
        received()
    assert refused.value.code
    lines = [
        line
        for line in capfd.readouterr().err.splitlines()
        if all(word in line for word in COMMANDS[setting])
    ]
    assert len(lines) == 1, lines
