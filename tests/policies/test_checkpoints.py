"""Damaged and foreign checkpoints are refused, with what is wrong."""

import pytest
from safetensors.torch import load_file, save_file

from lerobot_agpd.config import AdversaryConfig
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
