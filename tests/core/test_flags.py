"""Flags: which values are refused, and whether the message reaches the command line."""

import json

import draccus
import pytest
from draccus.utils import ParsingError
from lerobot.configs.train import TrainPipelineConfig

from lerobot_agpd import config as groups
from lerobot_agpd.config import CollectConfig, FlagError, MixingConfig
from lerobot_agpd.policies.agpd.configuration_agpd import AGPDConfig

WRONG = [
    "teacher.num_inference_steps=0",
    "guidance.scale=-1",
    "guidance.max_scale=0",
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
    "adversary.lr=0",
]
UNKNOWN = [
    "teacher.noise_scheduler=EDM",
    "guidance.at=x1",
    "representation.type=pixels",
    "collect.strategy=dagger",
    "collect.mixing.form=add",
    "replay.relabel=some",
]


def parse(*flags) -> TrainPipelineConfig:
    """What `lerobot-train` makes of `--policy.*` flags."""
    args = ["--dataset.repo_id=local/small", "--policy.type=agpd", "--policy.device=cpu"]
    return draccus.parse(TrainPipelineConfig, args=[*args, *(f"--policy.{flag}" for flag in flags)])


@pytest.mark.parametrize("flag", WRONG)
def test_wrong_values_are_refused_in_words_that_reach_the_command_line(flag):
    with pytest.raises(FlagError) as refusal:
        parse(flag)
    name, value = flag.split("=")
    assert f"--policy.{name}" in str(refusal.value)
    assert value.rstrip("0").rstrip(".") in str(refusal.value)


@pytest.mark.parametrize("flag", UNKNOWN)
def test_unknown_choices_are_refused(flag):
    name, value = flag.split("=")
    with pytest.raises(ParsingError, match=value) as refusal:
        parse(flag)
    assert name.rsplit(".", 1)[1] in str(refusal.value)


def test_defaults_are_valid_and_every_group_is_a_flag():
    assert isinstance(parse().policy, AGPDConfig)
    names = ("teacher", "guidance", "representation", "collect", "replay", "adversary")
    kinds = {type(getattr(parse().policy, name)) for name in names}
    declared = {kind for name, kind in vars(groups).items() if name.endswith("Config") and kind in kinds}
    assert kinds == declared


def test_flags_parse_and_round_trip():
    policy = parse(
        "collect.strategy=mixing", "collect.mixing.form=switch", "collect.mixing.weight=0.5"
    ).policy
    assert policy.collect == CollectConfig(strategy="mixing", mixing=MixingConfig(form="switch", weight=0.5))
    encoded = json.loads(json.dumps(draccus.encode(policy.collect)))
    assert draccus.decode(CollectConfig, encoded) == policy.collect
