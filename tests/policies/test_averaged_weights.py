"""Averaged weights of the diffusion policy: when they act, what a checkpoint holds, how a run resumes."""

import pytest
import torch
from accelerate import PartialState
from lerobot.policies import PreTrainedPolicy
from lerobot.utils.hub import HubMixin
from safetensors.torch import load_file, save_file
from small_diffusion import DENOISERS, fit, resumed, same, weights

from lerobot_agpd.flag_checks import FlagError
from lerobot_agpd.policies.diffusion_transformer.averaged_weights import RAW_WEIGHTS
from lerobot_agpd.policies.diffusion_transformer.modeling_diffusion_transformer import (
    DiffusionTransformerPolicy,
)
from lerobot_agpd.run import RunInfo


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
