"""The diffusion policy: its denoisers, its noise levels, its data, its flags."""

import json

import draccus
import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.datasets.factory import resolve_delta_timestamps
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.optim.optimizers import load_optimizer_state, save_optimizer_state
from lerobot.policies import make_policy as make_lerobot_policy, make_pre_post_processors
from lerobot.policies.diffusion.modeling_diffusion import DiffusionConditionalUnet1d, DiffusionPolicy
from small_diffusion import DENOISERS, SMALL, B
from torch.utils.data import default_collate

from lerobot_agpd.flag_checks import FlagError
from lerobot_agpd.policies.diffusion_transformer.configuration_diffusion_transformer import (
    DiffusionTransformerConfig,
)
from lerobot_agpd.policies.diffusion_transformer.mlp import MLPDenoiser
from lerobot_agpd.policies.diffusion_transformer.transformer import TransformerDenoiser


@pytest.mark.parametrize(
    ("denoiser", "network"),
    [("mlp", MLPDenoiser), ("transformer", TransformerDenoiser), ("unet", DiffusionConditionalUnet1d)],
)
def test_it_is_lerobots_diffusion_policy_with_the_network_named(make_policy, batch, denoiser, network):
    policy = make_policy(**DENOISERS[denoiser]).eval()
    assert isinstance(policy, DiffusionPolicy) and isinstance(policy.diffusion.unet, network)
    observation = {key: value[:, -1] for key, value in batch.items() if key.startswith("observation")}
    assert policy.select_action(observation).shape == (B, 2)


def test_the_unet_is_lerobots(make_policy, batch):
    """The same weights give the same loss and the same actions as `--policy.type=diffusion`."""
    ours = make_policy(noise_samples_per_frame=1, **DENOISERS["unet"])
    theirs = DiffusionPolicy(ours.config)
    theirs.load_state_dict(ours.state_dict())
    losses, chunks = [], []
    for policy in (ours, theirs):
        torch.manual_seed(1)
        losses.append(policy.train().forward(batch)[0])
        chunks.append(policy.eval().diffusion.generate_actions(batch))
    assert torch.equal(*losses) and torch.equal(*chunks)


def test_down_dims_size_the_unet_and_default_to_lerobots():
    assert DiffusionTransformerConfig(denoiser="unet", device="cpu").down_dims == (512, 1024, 2048)
    assert DiffusionTransformerConfig(denoiser="unet", device="cpu", down_dims=(32, 64)).down_dims == (32, 64)
    assert DiffusionTransformerConfig(denoiser="transformer", device="cpu").down_dims == (16,)


@pytest.mark.parametrize("denoiser", DENOISERS)
def test_optimizer_groups_survive_a_resume(make_policy, batch, tmp_path, denoiser):
    policy = make_policy(optimizer_weight_decay=0.1, **DENOISERS[denoiser]).train()
    optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())
    policy.forward(batch)[0].backward()
    optimizer.step()
    save_optimizer_state(optimizer, tmp_path)
    resumed = policy.config.get_optimizer_preset().build(policy.get_optim_params())
    load_optimizer_state(resumed, tmp_path)
    decays = [group["weight_decay"] for group in resumed.param_groups]
    assert decays == ([0.1, 0.0] if denoiser == "transformer" else [0.1])
    for old, new in zip(optimizer.param_groups, resumed.param_groups, strict=True):
        assert {k: old[k] for k in ("lr", "betas", "eps")} == {k: new[k] for k in ("lr", "betas", "eps")}
        for parameter in old["params"]:
            assert torch.equal(optimizer.state[parameter]["exp_avg"], resumed.state[parameter]["exp_avg"])


def test_repeated_noise_levels_average_the_same_loss(make_policy, batch):
    """Four noise levels per frame: the loss of a batch that holds every frame four times."""
    torch.manual_seed(0)
    policy, single = make_policy(noise_samples_per_frame=4), make_policy(noise_samples_per_frame=1)
    single.load_state_dict(policy.state_dict())
    policy.train(), single.train()
    torch.manual_seed(5)
    loss = policy.forward(batch)[0]
    torch.manual_seed(5)
    expected = single.forward({key: value.repeat_interleave(4, 0) for key, value in batch.items()})[0]
    assert torch.equal(loss, expected)


def test_one_observation_has_many_noise_levels_but_is_encoded_once(make_policy, batch):
    policy = make_policy(noise_samples_per_frame=3).train()
    seen = []
    policy.diffusion.unet.register_forward_pre_hook(
        lambda module, args, kwargs: seen.append((args[0], args[1], kwargs["global_cond"])), with_kwargs=True
    )
    policy.forward(batch)
    noisy, levels, condition = seen[0]
    assert len(noisy) == len(levels) == len(condition) == 3 * B
    rows = torch.cat([batch["observation.state"], batch["observation.environment_state"]], -1).flatten(1)
    assert torch.equal(condition, rows.repeat_interleave(3, 0))
    assert len(levels.unique()) > 1
    policy.eval().forward(batch)
    assert len(seen[1][0]) == B


@pytest.mark.parametrize("n_obs_steps", [1, 2])
@pytest.mark.parametrize("denoiser", DENOISERS)
def test_frames_from_memory_give_the_loss_of_the_loaders_chunks(demonstrations, denoiser, n_obs_steps):
    """The dataset's own delta frames, normalized by the processors, against chunks cut from memory."""
    options = {**SMALL, **DENOISERS[denoiser], "n_obs_steps": n_obs_steps}
    config = DiffusionTransformerConfig(**options)
    policy = make_lerobot_policy(config, ds_meta=demonstrations.meta).train()
    pre, _ = make_pre_post_processors(config, dataset_stats=demonstrations.meta.stats)
    picked = [1, 5, 9]
    frames = pre(default_collate([demonstrations[i] for i in picked]))
    config.in_memory = False
    chunks = LeRobotDataset(
        "local/small",
        root=demonstrations.root,
        delta_timestamps=resolve_delta_timestamps(config, demonstrations.meta),
    )
    losses = []
    for delivered in (frames, pre(default_collate([chunks[i] for i in picked]))):
        torch.manual_seed(3)
        losses.append(policy.forward(delivered)[0])
    torch.testing.assert_close(*losses)


@pytest.mark.parametrize(
    ("options", "flag"),
    [
        ({"noise_samples_per_frame": 0}, "--policy.noise_samples_per_frame"),
        ({"n_action_steps": 8}, "--policy.n_action_steps=8"),
    ],
)
def test_wrong_flags_are_named(make_policy, options, flag):
    with pytest.raises(FlagError, match=flag):
        make_policy(**options)


def test_a_policy_without_a_state_is_refused(make_policy, input_features):
    without = {k: v for k, v in input_features.items() if k != "observation.state"}
    with pytest.raises(FlagError, match="observation.state and action"):
        make_policy(input_features=without)


@pytest.mark.parametrize(("flag", "value"), [("denoiser", "rnn"), ("prediction_type", "v_prediction")])
def test_unknown_choices_are_named(flag, value):
    with pytest.raises(draccus.ParsingError, match=f"(?s){flag}.*{value}"):
        draccus.decode(PreTrainedConfig, {"type": "diffusion_transformer", flag: value})


def test_config_round_trip(make_policy, tmp_path):
    config = make_policy(ema=False, in_memory=False).config
    config.save_pretrained(tmp_path)
    assert json.loads((tmp_path / "config.json").read_text())["type"] == "diffusion_transformer"
    loaded = PreTrainedConfig.from_pretrained(tmp_path)
    assert isinstance(loaded, DiffusionTransformerConfig)
    assert loaded == config


@pytest.mark.parametrize("in_memory", [True, False])
def test_what_the_loader_delivers(make_policy, in_memory):
    config = make_policy(in_memory=in_memory).config
    assert config.chunk_delta_indices == list(range(-1, 7))
    requested = (config.action_delta_indices, config.observation_delta_indices)
    assert requested == ((None, None) if in_memory else (list(range(-1, 7)), [-1, 0]))
