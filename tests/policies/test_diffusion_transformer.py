"""Averaged weights: swapped in for evaluation and saving, swapped out for training."""

import json

import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy
from safetensors.torch import load_file

from lerobot_agpd.policies.diffusion_transformer.configuration_diffusion_transformer import (
    DiffusionTransformerConfig,
    EMAConfig,
    MLPDenoiserConfig,
)
from lerobot_agpd.policies.diffusion_transformer.denoisers import MLPDenoiser
from lerobot_agpd.policies.diffusion_transformer.modeling_diffusion_transformer import (
    RAW_WEIGHTS,
    DiffusionTransformerPolicy,
)
from lerobot_agpd.run import RunInfo, declared_run

B = 4


@pytest.fixture
def make_policy(input_features, output_features):
    def build(**options) -> DiffusionTransformerPolicy:
        config = DiffusionTransformerConfig(
            **{
                "horizon": 8,
                "n_action_steps": 4,
                "num_train_timesteps": 10,
                "mlp": MLPDenoiserConfig(width=16, n_blocks=1, time_embed_dim=8),
                "input_features": dict(input_features),
                "output_features": dict(output_features),
                "device": "cpu",
                "push_to_hub": False,
                **options,
            }
        )
        return DiffusionTransformerPolicy(config)

    return build


@pytest.fixture
def batch():
    return {
        "observation.state": torch.randn(B, 2, 2),
        "observation.environment_state": torch.randn(B, 2, 3),
        "action": torch.randn(B, 8, 2),
        "action_is_pad": torch.zeros(B, 8, dtype=torch.bool),
    }


def weights(policy):
    return {key: value.detach().clone() for key, value in policy.state_dict().items()}


def same(left, right) -> bool:
    return left.keys() == right.keys() and all(torch.equal(left[key], right[key]) for key in left)


def fit(policy, batch, n_steps):
    """A few of LeRobot's training steps; the weights after each of them."""
    policy.train()
    optimizer = torch.optim.SGD(policy.parameters(), lr=0.1)
    after = []
    for _ in range(n_steps):
        optimizer.zero_grad()
        policy.forward(batch)[0].backward()
        optimizer.step()
        policy.update()
        after.append(weights(policy))
    return after


def averaged(after, power, max_decay):
    """The moving average by its formula: decay 1 - (1 + n)^-power after n steps, from the first step on."""
    mean = after[0]
    for n, new in enumerate(after[1:], start=1):
        decay = min(1 - (1 + n) ** -power, max_decay)
        mean = {key: decay * mean[key] + (1 - decay) * new[key] for key in new}
    return mean


def test_eval_swaps_the_average_in_and_train_swaps_it_out(make_policy, batch):
    policy = make_policy(ema=EMAConfig(power=0.5, max_decay=0.6))
    after = fit(policy, batch, 6)
    policy.eval()
    expected = averaged(after, 0.5, 0.6)
    for key, value in weights(policy).items():
        torch.testing.assert_close(value, expected[key], rtol=1e-5, atol=1e-6)
    assert not same(weights(policy), after[-1])
    policy.eval()  # again: nothing changes
    assert not same(weights(policy), after[-1])
    policy.train()
    assert same(weights(policy), after[-1])
    policy.train()
    assert same(weights(policy), after[-1])


def test_evaluation_leaves_the_training_alone(make_policy, batch):
    states = []
    for interrupted in (False, True):
        torch.manual_seed(0)
        policy = make_policy()
        fit(policy, batch, 2)
        if interrupted:
            policy.eval()
            with torch.random.fork_rng():
                policy.diffusion.generate_actions(batch)
        torch.manual_seed(1)
        fit(policy, batch, 2)
        policy.eval()
        states.append(weights(policy))
    assert same(*states)


@pytest.mark.parametrize("training", [True, False])
def test_save_writes_the_average_and_the_raw_weights(make_policy, batch, tmp_path, training):
    policy = make_policy()
    raw = fit(policy, batch, 4)[-1]
    policy.eval()
    mean = weights(policy)
    policy.train(training)
    policy.save_pretrained(tmp_path)
    assert same(weights(policy), raw if training else mean)  # saving leaves the mode's weights
    loaded = DiffusionTransformerPolicy.from_pretrained(tmp_path)
    assert same(weights(loaded), mean) and not same(mean, raw)
    stored = load_file(tmp_path / RAW_WEIGHTS)
    assert int(stored.pop("ema_steps")) == 4
    assert same({f"diffusion.{key}": value for key, value in stored.items()}, raw)


def test_without_training_or_average_no_raw_weights_are_written(make_policy, batch, tmp_path):
    make_policy().save_pretrained(tmp_path / "untrained")
    assert not (tmp_path / "untrained" / RAW_WEIGHTS).exists()
    policy = make_policy(ema=EMAConfig(enable=False))
    raw = fit(policy, batch, 2)[-1]
    policy.eval()
    assert same(weights(policy), raw)
    policy.save_pretrained(tmp_path / "raw")
    assert not (tmp_path / "raw" / RAW_WEIGHTS).exists()
    assert same(weights(DiffusionTransformerPolicy.from_pretrained(tmp_path / "raw")), raw)


def test_resuming_continues_raw_weights_and_average(make_policy, batch, tmp_path):
    torch.manual_seed(0)
    policy = make_policy()
    fit(policy, batch, 3)
    policy.save_pretrained(tmp_path)
    torch.manual_seed(1)
    fit(policy, batch, 3)
    policy.eval()

    config = PreTrainedConfig.from_pretrained(tmp_path)
    config.pretrained_path = tmp_path
    resumed = DiffusionTransformerPolicy.from_pretrained(tmp_path, config=config)
    torch.manual_seed(1)
    with declared_run(RunInfo(resume=True)):
        fit(resumed, batch, 3)
    resumed.eval()
    assert same(weights(resumed), weights(policy))


def test_resuming_without_raw_weights_is_refused(make_policy, batch, tmp_path):
    policy = make_policy()
    fit(policy, batch, 1)
    policy.save_pretrained(tmp_path)
    (tmp_path / RAW_WEIGHTS).unlink()
    config = PreTrainedConfig.from_pretrained(tmp_path)
    config.pretrained_path = tmp_path
    resumed = DiffusionTransformerPolicy.from_pretrained(tmp_path, config=config)
    with declared_run(RunInfo(resume=True)), pytest.raises(FileNotFoundError, match=RAW_WEIGHTS):
        fit(resumed, batch, 1)


def test_starting_from_a_checkpoint_starts_from_its_average(make_policy, batch, tmp_path):
    policy = make_policy()
    fit(policy, batch, 3)
    policy.eval()
    policy.save_pretrained(tmp_path)
    config = PreTrainedConfig.from_pretrained(tmp_path)
    config.pretrained_path = tmp_path
    started = DiffusionTransformerPolicy.from_pretrained(tmp_path, config=config)
    started.train()
    with declared_run(RunInfo(resume=False)):
        started.forward(batch)
    assert same(weights(started), weights(policy))


def test_it_is_lerobots_diffusion_policy_with_another_network(make_policy, batch):
    policy = make_policy().eval()
    assert isinstance(policy, DiffusionPolicy) and isinstance(policy.diffusion.unet, MLPDenoiser)
    observation = {key: value[:, -1] for key, value in batch.items() if key.startswith("observation")}
    assert policy.select_action(observation).shape == (B, 2)


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


def test_denoiser_sees_chunk_step_and_condition():
    net = MLPDenoiser(horizon=4, action_dim=2, cond_dim=3, width=16, n_blocks=2, time_embed_dim=8)
    x, t, cond = torch.randn(B, 4, 2), torch.arange(B), torch.randn(B, 3)
    out = net(x, t, cond)
    assert out.shape == x.shape
    assert torch.equal(net(x, 3, cond)[3], net(x, torch.full((B,), 3), cond)[3])
    for changed in ((x + 1, t, cond), (x, t + 1, cond), (x, t, cond + 1)):
        assert not torch.allclose(net(*changed), out)


@pytest.mark.parametrize(
    ("options", "flag"),
    [
        ({"denoiser": "rnn"}, "--policy.denoiser"),
        ({"noise_samples_per_frame": 0}, "--policy.noise_samples_per_frame"),
        ({"n_action_steps": 8}, "--policy.n_action_steps=8"),
    ],
)
def test_wrong_flags_are_named(make_policy, options, flag):
    with pytest.raises(ValueError, match=flag):
        make_policy(**options)


def test_wrong_group_flags_are_named():
    for build, flag in (
        (lambda: MLPDenoiserConfig(width=0), "--policy.mlp.width"),
        (lambda: EMAConfig(power=0), "--policy.ema.power"),
        (lambda: EMAConfig(max_decay=1), "--policy.ema.max_decay"),
    ):
        with pytest.raises(ValueError, match=flag):
            build()


def test_config_round_trip(make_policy, tmp_path):
    config = make_policy(ema=EMAConfig(power=0.6), in_memory=False).config
    config.save_pretrained(tmp_path)
    assert json.loads((tmp_path / "config.json").read_text())["type"] == "diffusion_transformer"
    loaded = PreTrainedConfig.from_pretrained(tmp_path)
    assert isinstance(loaded, DiffusionTransformerConfig)
    assert (loaded.mlp, loaded.ema, loaded.horizon) == (config.mlp, config.ema, 8)


@pytest.mark.parametrize("in_memory", [True, False])
def test_what_the_loader_is_asked_for(make_policy, in_memory):
    config = make_policy(in_memory=in_memory).config
    assert config.chunk_offsets == list(range(-1, 7))
    asked = (config.action_delta_indices, config.observation_delta_indices)
    assert asked == ((None, None) if in_memory else (list(range(-1, 7)), [-1, 0]))
