"""Settings that make no sense: whatever the flag, the message names it."""

import types
from dataclasses import fields, is_dataclass
from typing import Literal, Union, get_args, get_origin, get_type_hints

import draccus
import pytest
import yaml
from draccus.utils import ParsingError
from lerobot.configs import PreTrainedConfig
from lerobot.envs import EnvConfig

from lerobot_agpd.config import StudentConfig
from lerobot_agpd.policies.act_diffusion.configuration_act_diffusion import ACTDiffusionConfig
from lerobot_agpd.policies.agpd.configuration_agpd import AGPDConfig
from lerobot_agpd.policies.agpd_diffusion.configuration_agpd_diffusion import AGPDDiffusionConfig
from lerobot_agpd.policies.diffusion_transformer.configuration_diffusion_transformer import (
    DiffusionTransformerConfig,
)

WRONG = {
    float: ("nan", "inf", "-inf", "much"),
    int: ("some", "1.5", "nan"),
    bool: ("perhaps",),
}
GROUPS = set(get_type_hints(StudentConfig)) - set(get_type_hints(PreTrainedConfig))
DIFFUSION = [AGPDDiffusionConfig, DiffusionTransformerConfig, ACTDiffusionConfig]
COUNTS = ("num_train_timesteps", "num_inference_steps", "n_obs_steps", "horizon", "n_action_steps")


def kinds(annotation):
    """The plain types, and choices, that a field's annotation allows."""
    if get_origin(annotation) in (Union, types.UnionType):
        return [kind for part in get_args(annotation) for kind in kinds(part)]
    return ["choice"] if get_origin(annotation) is Literal else [annotation]


def wrong_settings(group, prefix):
    """Every field of a group of flags, and of the groups inside, with values that it cannot have."""
    hints = get_type_hints(group)
    for entry in fields(group):
        allowed, flag = kinds(hints[entry.name]), f"{prefix}{entry.name}"
        if is_dataclass(allowed[0]) and not issubclass(allowed[0], EnvConfig):
            yield from wrong_settings(allowed[0], f"{flag}.")
        elif "choice" in allowed:
            yield f"{flag}=none_of_these"
        else:
            yield from (f"{flag}={value}" for kind in allowed for value in WRONG.get(kind, ()))


def all_wrong_settings():
    hints = get_type_hints(StudentConfig)
    return [setting for name in sorted(GROUPS) for setting in wrong_settings(hints[name], f"{name}.")]


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
    groups = {setting.split(".")[0] for setting in all_wrong_settings()}
    assert len(all_wrong_settings()) > 60 and groups == GROUPS


@pytest.mark.parametrize("setting", all_wrong_settings())
def test_a_setting_that_makes_no_sense_is_named(setting):
    assert setting.split("=")[0].rsplit(".", 1)[-1] in refusal(AGPDConfig, setting)


@pytest.mark.parametrize("value", ["nan", "inf", "-inf"])
def test_min_reward_nan(value):
    assert "--policy.collect.min_reward" in refusal(AGPDConfig, f"collect.min_reward={value}")


@pytest.mark.parametrize("value", ["a/b/c", "me/has space", "-me/x", "me/x--y", "a" * 97])
def test_a_malformed_repo_id(value):
    assert "--policy.collect.repo_id" in refusal(AGPDConfig, f"collect.repo_id={value}")


@pytest.mark.parametrize("policy_class", [AGPDConfig, *DIFFUSION])
@pytest.mark.parametrize("value", ["nope", "piecewise_constant"])
def test_scheduler_name_nope(policy_class, value):
    message = refusal(policy_class, f"scheduler_name={value}")
    assert "--policy.scheduler_name" in message and "cosine" in message


@pytest.mark.parametrize("policy_class", DIFFUSION)
@pytest.mark.parametrize("name", COUNTS)
@pytest.mark.parametrize("value", [0, -4])
def test_zero_or_negative_step_counts(policy_class, name, value):
    assert f"--policy.{name} must be at least 1, got {value}" in refusal(policy_class, f"{name}={value}")
