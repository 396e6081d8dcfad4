"""Damaged and foreign checkpoints are refused, with what is wrong."""

import json

import pytest
from draccus.utils import ParsingError
from lerobot.configs import PreTrainedConfig
from safetensors.torch import load_file, save_file

from lerobot_agpd.config import AdversaryConfig
from lerobot_agpd.flag_checks import FlagError
from lerobot_agpd.loading import read_policy_config
from lerobot_agpd.policies.agpd.modeling_agpd import AGPDPolicy


@pytest.fixture
def checkpoint(agpd_config, tmp_path):
    AGPDPolicy(agpd_config(adversary=AdversaryConfig(weight=0))).save_pretrained(tmp_path)
    return tmp_path


def test_truncated_weights(checkpoint):
    file = checkpoint / "model.safetensors"
    file.write_bytes(file.read_bytes()[:1000])
    with pytest.raises(ValueError, match=r"model.safetensors cannot be read .* is the checkpoint complete\?"):
        AGPDPolicy.from_pretrained(checkpoint)


def test_missing_weights(checkpoint):
    file = checkpoint / "model.safetensors"
    weights = load_file(file)
    del weights["model.action_head.weight"]
    save_file(weights, file)
    with pytest.raises(ValueError, match=r"missing: \['model.action_head.weight'\] \(1 in all\)"):
        AGPDPolicy.from_pretrained(checkpoint)


def test_weights_of_another_size(checkpoint, agpd_config):
    config = agpd_config(adversary=AdversaryConfig(weight=0), dim_model=16)
    with pytest.raises(ValueError, match=r"of another shape: .*model\."):
        AGPDPolicy.from_pretrained(checkpoint, config=config)


def test_an_adversary_may_join_later(checkpoint, agpd_config):
    policy = AGPDPolicy.from_pretrained(checkpoint, config=agpd_config())
    assert policy.discriminator is not None


@pytest.mark.parametrize("group", ["guidance", "collect"])
def test_a_setting_of_another_version_is_named(checkpoint, group):
    """LeRobot's own way to read a checkpoint, which has no place for a plugin to leave such a setting out."""
    file = checkpoint / "config.json"
    content = json.loads(file.read_text())
    content[group]["of_tomorrow"] = 1
    file.write_text(json.dumps(content))
    with pytest.raises(ParsingError, match=f"{group}.*of_tomorrow"):
        PreTrainedConfig.from_pretrained(checkpoint)
    with pytest.raises(
        FlagError, match="--policy.path=.* another version .*of_tomorrow.* remove from the file"
    ):
        read_policy_config(checkpoint, "--policy.path")
