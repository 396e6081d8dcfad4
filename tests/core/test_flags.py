"""Flags: which values are refused, and whether the message reaches the command line."""

import json

import draccus
import pytest
import yaml
from draccus.utils import ParsingError
from lerobot.configs.train import TrainPipelineConfig

from lerobot_agpd.config import CollectConfig, MixingConfig
from lerobot_agpd.flag_checks import FlagError
from lerobot_agpd.policies.agpd.configuration_agpd import AGPDConfig

WRONG = [
    "teacher.num_inference_steps=0",
    "guidance.scale=-1",
    "guidance.pull=-0.1",
    "guidance.pull=1.1",
    "guidance.max_pull=0.0",
    "guidance.max_pull=1.5",
    "guidance.max_scale=0.0",
    "collect.every=-1",
    "collect.warmup=0",
    "collect.episodes=0",
    "collect.n_envs=0",
    "collect.rounds=-1",
    "collect.teacher_only_fraction=1.5",
    "collect.retry_fraction=-0.5",
    "collect.n_action_steps=0",
    "collect.n_action_steps=101",
    "collect.push_to_hub=true",
    "collect.mixing.weight=1.1",
    "replay.collected_fraction=1.0",
    "adversary.weight=-1",
    "adversary.start=-1",
    "adversary.every=0",
    "adversary.lr=0.0",
]
UNKNOWN = [
    "teacher.noise_scheduler=EDM",
    "guidance.at=x1",
    "representation.type=pixels",
    "collect.strategy=dagger",
    "collect.mixing.form=add",
    "replay.relabel=some",
]


def decode(flag) -> AGPDConfig:
    """The configuration that one `--policy.*` flag makes."""
    path, value = flag.split("=")
    options = yaml.safe_load(value)
    for name in reversed(path.split(".")):
        options = {name: options}
    return draccus.decode(AGPDConfig, {"device": "cpu", **options})


@pytest.mark.parametrize("flag", WRONG)
def test_wrong_values_are_refused_and_named(flag):
    name, value = flag.split("=")
    with pytest.raises(FlagError, match=f"--policy.{name}\\b.*{value}"):
        decode(flag)


@pytest.mark.parametrize("flag", UNKNOWN)
def test_unknown_choices_are_refused(flag):
    name, value = flag.split("=")
    with pytest.raises(ParsingError, match=f"{value}") as refusal:
        decode(flag)
    assert name.rsplit(".", 1)[1] in str(refusal.value)


def parse(*flags) -> TrainPipelineConfig:
    """What `lerobot-train` makes of its command line."""
    args = ["--dataset.repo_id=local/small", "--policy.type=agpd", "--policy.device=cpu"]
    return draccus.parse(TrainPipelineConfig, args=[*args, *flags])


def test_a_refusal_reaches_the_command_line():
    with pytest.raises(ParsingError, match=r"--policy.guidance.scale .*-1") as refusal:
        parse("--policy.guidance.scale=-1")
    assert "Couldn't instantiate" not in str(refusal.value)


def test_flags_parse_and_round_trip():
    flags = ("strategy=mixing", "mixing.form=switch", "mixing.weight=0.5")
    policy = parse(*(f"--policy.collect.{flag}" for flag in flags)).policy
    assert isinstance(policy, AGPDConfig)
    assert policy.collect == CollectConfig(strategy="mixing", mixing=MixingConfig(form="switch", weight=0.5))
    encoded = json.loads(json.dumps(draccus.encode(policy.collect)))
    assert draccus.decode(CollectConfig, encoded) == policy.collect
