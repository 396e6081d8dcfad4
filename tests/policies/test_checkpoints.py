"""Damaged and foreign checkpoints are refused, with what is wrong."""

import json

import draccus
import pytest
from draccus.utils import ParsingError
from lerobot.configs import PreTrainedConfig
from lerobot.configs.train import TrainPipelineConfig
from safetensors.torch import load_file, save_file

from lerobot_agpd.config import AdversaryConfig
from lerobot_agpd.policies.agpd.configuration_agpd import AGPDConfig
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


@pytest.mark.parametrize("groups", [("guidance",), ("collect", "replay")])
def test_training_settings_of_another_version_are_left_out_with_a_warning(checkpoint, groups, caplog):
    """They say nothing about what the policy does; LeRobot's own way to read a checkpoint, as in `lerobot-eval`."""
    file = checkpoint / "config.json"
    content = json.loads(file.read_text())
    for group in groups:
        content[group]["of_tomorrow"] = 1
    file.write_text(json.dumps(content))
    policy = AGPDPolicy.from_pretrained(checkpoint, config=PreTrainedConfig.from_pretrained(checkpoint))
    assert isinstance(policy.config, AGPDConfig)
    (warning,) = [
        record.getMessage() for record in caplog.records if "another version" in record.getMessage()
    ]
    assert all(f"'{group}.of_tomorrow'" in warning for group in groups)


def test_other_settings_of_another_version_are_refused(checkpoint):
    """A setting of the network decides what the policy does; so does a flag of a run that is mistyped."""
    file = checkpoint / "config.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), "of_tomorrow": 1}))
    with pytest.raises(ParsingError, match="of_tomorrow"):
        PreTrainedConfig.from_pretrained(checkpoint)
    policy = {"type": "agpd", "device": "cpu", "guidance": {"of_tomorrow": 1}}
    with pytest.raises(ParsingError, match="of_tomorrow"):
        draccus.decode(TrainPipelineConfig, {"dataset": {"repo_id": "local/x"}, "policy": policy})
