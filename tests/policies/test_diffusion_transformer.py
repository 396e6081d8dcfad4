"""The diffusion policy: its averaged weights, its checkpoints, its denoisers, its data."""

import json

import draccus
import pytest
import torch
from accelerate import PartialState
from lerobot.configs import PreTrainedConfig
from lerobot.datasets.factory import resolve_delta_timestamps
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.optim.optimizers import load_optimizer_state, save_optimizer_state
from lerobot.policies import PreTrainedPolicy, make_policy as make_lerobot_policy, make_pre_post_processors
from lerobot.policies.diffusion.modeling_diffusion import DiffusionConditionalUnet1d, DiffusionPolicy
from lerobot.utils.hub import HubMixin
from safetensors.torch import load_file, save_file
from torch.utils.data import default_collate

from lerobot_agpd.config import FlagError
from lerobot_agpd.policies.diffusion_transformer.averaged_weights import RAW_WEIGHTS
from lerobot_agpd.policies.diffusion_transformer.configuration_diffusion_transformer import (
    DiffusionTransformerConfig,
    MLPDenoiserConfig,
    TransformerDenoiserConfig,
)
from lerobot_agpd.policies.diffusion_transformer.mlp import MLPDenoiser
from lerobot_agpd.policies.diffusion_transformer.modeling_diffusion_transformer import (
    DiffusionTransformerPolicy,
)
from lerobot_agpd.policies.diffusion_transformer.transformer import TransformerDenoiser
from lerobot_agpd.run import RunInfo

B = 4
DENOISERS = {
    "mlp": {"denoiser": "mlp"},
    "transformer": {"denoiser": "transformer"},
    "unet": {"denoiser": "unet", "down_dims": (16,)},
}


SMALL = {
    "horizon": 8,
    "n_action_steps": 4,
    "num_train_timesteps": 10,
    "mlp": MLPDenoiserConfig(width=16, n_blocks=1),
    "transformer": TransformerDenoiserConfig(width=16, n_layers=1, n_heads=2, attention_dropout=0.0),
    "device": "cpu",
    "push_to_hub": False,
}


@pytest.fixture
def make_policy(input_features, output_features):
    def build(run=None, **options) -> DiffusionTransformerPolicy:
        features = {"input_features": dict(input_features), "output_features": dict(output_features)}
        config = DiffusionTransformerConfig(**{**SMALL, **features, **options})
        return DiffusionTransformerPolicy(config, run=run or RunInfo())

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


def resumed(folder, resume=True) -> DiffusionTransformerPolicy:
    """The policy of a run that continues, or only starts from, a checkpoint."""
    config = PreTrainedConfig.from_pretrained(folder)
    config.pretrained_path = folder
    return DiffusionTransformerPolicy.from_pretrained(folder, config=config, run=RunInfo(resume=resume))


def averaged(after):
    """The moving average by its formula: decay 1 - (1 + n)^-0.75 after n steps, from the first step on."""
    mean = after[0]
    for n, new in enumerate(after[1:], start=1):
        decay = 1 - (1 + n) ** -0.75
        mean = {key: decay * mean[key] + (1 - decay) * new[key] for key in new}
    return mean


@pytest.mark.parametrize("denoiser", DENOISERS)
def test_eval_swaps_the_average_in_and_train_swaps_it_out(make_policy, batch, denoiser):
    policy = make_policy(**DENOISERS[denoiser])
    after = fit(policy, batch, 6)
    policy.eval()
    expected = averaged(after)
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
    policy = make_policy(ema=False)
    raw = fit(policy, batch, 2)[-1]
    policy.eval()
    assert same(weights(policy), raw)
    policy.save_pretrained(tmp_path / "raw")
    assert not (tmp_path / "raw" / RAW_WEIGHTS).exists()
    assert same(weights(DiffusionTransformerPolicy.from_pretrained(tmp_path / "raw")), raw)


@pytest.mark.parametrize("denoiser", DENOISERS)
def test_resuming_continues_raw_weights_and_average(make_policy, batch, tmp_path, denoiser):
    torch.manual_seed(0)
    policy = make_policy(**DENOISERS[denoiser])
    fit(policy, batch, 3)
    policy.save_pretrained(tmp_path)
    torch.manual_seed(1)
    fit(policy, batch, 3)
    policy.eval()

    continued = resumed(tmp_path)
    torch.manual_seed(1)
    fit(continued, batch, 3)
    continued.eval()
    assert same(weights(continued), weights(policy))


def test_resuming_without_raw_weights_is_refused(make_policy, batch, tmp_path):
    policy = make_policy()
    fit(policy, batch, 1)
    policy.save_pretrained(tmp_path)
    (tmp_path / RAW_WEIGHTS).unlink()
    with pytest.raises(FileNotFoundError, match=RAW_WEIGHTS):
        fit(resumed(tmp_path), batch, 1)


def test_a_state_dict_given_for_saving_is_replaced_by_the_average(make_policy, batch, tmp_path):
    policy = make_policy()
    raw = fit(policy, batch, 3)[-1]
    policy.save_pretrained(tmp_path, state_dict=policy.state_dict())
    assert same(weights(policy), raw)
    policy.eval()
    assert same(weights(DiffusionTransformerPolicy.from_pretrained(tmp_path)), weights(policy))


@pytest.fixture
def later_lerobot(monkeypatch):
    """Saving as in LeRobot after 0.6.1: on every process, without `state_dict`; the base class tests the rank."""

    def save_on_main_process(policy, save_directory):
        if PartialState().is_main_process:
            policy.config._save_pretrained(save_directory)
            save_file(policy.state_dict(), save_directory / "model.safetensors")

    monkeypatch.setattr(PreTrainedPolicy, "_save_pretrained", save_on_main_process)
    monkeypatch.setattr(PreTrainedPolicy, "save_pretrained", HubMixin.save_pretrained)


def test_later_versions_save_without_a_state_dict(make_policy, batch, tmp_path, later_lerobot):
    policy = make_policy()
    raw = fit(policy, batch, 3)[-1]
    policy.save_pretrained(tmp_path)
    assert same(weights(policy), raw)
    policy.eval()
    assert same(weights(DiffusionTransformerPolicy.from_pretrained(tmp_path)), weights(policy))
    fit(resumed(tmp_path), batch, 1)


def test_only_the_main_process_writes(make_policy, batch, tmp_path, later_lerobot, monkeypatch):
    policy = make_policy()
    raw = fit(policy, batch, 3)[-1]
    monkeypatch.setattr(PartialState, "is_main_process", False)
    policy.save_pretrained(tmp_path)
    assert list(tmp_path.iterdir()) == []
    assert same(weights(policy), raw)


@pytest.mark.parametrize(
    ("run", "flag"),
    [(RunInfo(lerobot_ema=True), "--ema.enable=true"), (RunInfo(sharded=True), r"--parallelism\.\*")],
)
def test_runs_that_cannot_be_averaged_are_refused(make_policy, batch, run, flag):
    with pytest.raises(FlagError, match=rf"(?s)--policy.ema=true.*{flag}.*--policy.ema=false"):
        make_policy(run=run)
    fit(make_policy(run=run, ema=False), batch, 1)


def test_batch_normalization_beside_the_average_is_pointed_out(make_policy, batch, caplog):
    policy = make_policy()
    policy.diffusion.encoder = torch.nn.BatchNorm1d(2)
    fit(policy, batch, 1)
    assert "--policy.use_group_norm=true" in caplog.text


def test_starting_from_a_checkpoint_starts_from_its_average(make_policy, batch, tmp_path):
    policy = make_policy()
    fit(policy, batch, 3)
    policy.eval()
    policy.save_pretrained(tmp_path)
    started = resumed(tmp_path, resume=False).train()
    started.forward(batch)
    assert same(weights(started), weights(policy))


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
