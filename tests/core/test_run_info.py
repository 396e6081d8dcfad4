"""What a policy learns of the run that builds it."""

import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.policies import make_policy
from point_environment import PointEnv

from lerobot_agpd.config import AdversaryConfig, CollectConfig
from lerobot_agpd.flag_checks import FlagError
from lerobot_agpd.policies.agpd.modeling_agpd import AGPDPolicy
from lerobot_agpd.run import RunInfo


@pytest.fixture
def train_config(agpd_config, tmp_path):
    dataset = DatasetConfig(repo_id="local/small")
    facts = {"output_dir": tmp_path, "env": PointEnv(), "steps": 7}
    return TrainPipelineConfig(dataset=dataset, policy=agpd_config(), **facts)


def build(policy_config):
    """A function that knows nothing of the run, like LeRobot's `make_policy`."""
    return RunInfo.of(policy_config)


def call_with(value, function, *args):
    """Call a function while holding a value in a local variable."""
    result = function(*args)
    assert value is not None
    return result


def test_the_run_is_that_of_a_caller_whatever_the_command_line_says(train_config, monkeypatch, tmp_path):
    monkeypatch.setattr(sys, "argv", ["a-script", "--steps=99", "--output_dir=elsewhere"])
    policy = train_config.policy
    run = call_with(train_config, build, policy)
    assert run == RunInfo(output_dir=tmp_path, env=train_config.env, steps=7)


def test_outside_of_a_run_there_is_none(train_config, agpd_config):
    policy_config = agpd_config()
    assert call_with(train_config, build, policy_config) is None, "the caller trains another policy"
    assert build(agpd_config()) is None


def test_lerobots_own_way_to_build_a_policy_finds_the_run(train_config, demonstrations):
    train_config.policy.collect, train_config.policy.adversary = CollectConfig(every=0), AdversaryConfig(0)

    def train(config):
        return make_policy(config.policy, ds_meta=demonstrations.meta)

    assert train(train_config).agpd.run == RunInfo.from_train_config(train_config)


def test_wrong_input_ends_a_run_before_its_first_step(train_config, demonstrations):
    def train(config):
        return make_policy(config.policy, ds_meta=demonstrations.meta)

    with pytest.raises(FlagError, match="--policy.teacher.path is not set.*--policy.collect.every=0"):
        train(train_config)


def test_a_policy_built_outside_of_a_run_needs_nothing(agpd_config, demonstrations):
    policy = AGPDPolicy(agpd_config(), demonstrations.meta.stats, demonstrations.meta)
    policy.update()  # no round, no error
    with pytest.raises(FlagError, match="--policy.teacher.path"):
        policy.agpd  # noqa: B018


def test_image_transforms_are_the_loaders(train_config):
    assert RunInfo.from_train_config(train_config).image_transforms is None
    train_config.dataset.image_transforms.enable = True
    transforms = RunInfo.from_train_config(train_config).image_transforms
    assert transforms(torch.rand(3, 8, 8)).shape == (3, 8, 8)


@pytest.mark.parametrize(
    ("group", "value", "fact"),
    [
        ("accelerator", {"gradient_accumulation": SimpleNamespace(steps=4)}, {"steps_per_update": 4}),
        ("accelerator", {}, {"steps_per_update": 1}),
        ("ema", {"enable": True}, {"lerobot_ema": True}),
        ("ema", {"enable": False}, {"lerobot_ema": False}),
        ("parallelism", {"dp_shard": 2}, {"sharded": True}),
        ("parallelism", {"dp_shard": 1}, {"sharded": False}),
        ("parallelism", {}, {"sharded": False}),
    ],
)
def test_settings_of_later_lerobots(train_config, group, value, fact):
    setattr(train_config, group, SimpleNamespace(**value))
    run = RunInfo.from_train_config(train_config)
    assert {name: getattr(run, name) for name in fact} == fact


def test_sharded_weights_are_refused(agpd_config, demonstrations):
    config = agpd_config(collect=CollectConfig(every=0), adversary=AdversaryConfig(weight=0))
    with pytest.raises(FlagError, match="--parallelism"):
        AGPDPolicy(config, dataset_meta=demonstrations.meta, run=RunInfo(sharded=True))


def test_resume_is_told(train_config):
    train_config.resume, train_config.output_dir = True, Path("outputs/x")
    run = RunInfo.from_train_config(train_config)
    assert run.resume and run.output_dir == Path("outputs/x")
