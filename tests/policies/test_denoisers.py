"""The networks: what each sees, what its masks hide, which of its weights decay, and that they learn."""

import pytest
import torch
from hypothesis import given, settings, strategies as st
from torch import nn

from lerobot_agpd.flag_checks import FlagError
from lerobot_agpd.policies.diffusion_transformer.configuration_diffusion_transformer import (
    MLPDenoiserConfig,
    TransformerDenoiserConfig,
)
from lerobot_agpd.policies.diffusion_transformer.mlp import MLPDenoiser
from lerobot_agpd.policies.diffusion_transformer.model import repeat_for_actions
from lerobot_agpd.policies.diffusion_transformer.transformer import (
    TransformerDenoiser,
    weight_decay_groups,
)

B, H, A, C, D = 4, 6, 2, 3, 5
SMALL = {"width": 16, "n_layers": 2, "n_heads": 2, "attention_dropout": 0.0}


def transformer(condition_is_history=True, **options) -> TransformerDenoiser:
    config = TransformerDenoiserConfig(**{**SMALL, **options})
    return TransformerDenoiser(H, A, C, D, config, condition_is_history).eval()


def mlp() -> MLPDenoiser:
    return MLPDenoiser(H, A, C * D, MLPDenoiserConfig(width=16, n_blocks=2))


def inputs():
    return torch.randn(B, H, A), torch.arange(B), torch.randn(B, C * D)


def moved_steps(net, changed: str, step: int) -> list[bool]:
    """Which of the H predicted steps move when one noisy action, or one condition token, changes."""
    net = net.double()
    x, k, condition = inputs()
    x, condition = x.double(), condition.double()
    before = net(x, k, condition)
    (x if changed == "action" else condition.view(B, C, D))[:, step] += 1.0
    difference = (net(x, k, condition) - before).abs().amax(dim=(0, 2))
    return (difference > 1e-13).tolist()


@pytest.mark.parametrize(
    "net",
    [mlp, transformer, lambda: transformer(causal=False)],
    ids=["mlp", "causal", "bidirectional"],
)
def test_denoiser_sees_chunk_step_and_condition(net):
    net = net()
    x, k, condition = inputs()
    out = net(x, k, condition)
    assert out.shape == x.shape
    torch.testing.assert_close(net(x, 3, condition), net(x, torch.full((B,), 3), condition))
    for changed in ((x + 1, k, condition), (x, k + 1, condition), (x, k, condition + 1)):
        assert not torch.allclose(net(*changed), out)


@given(step=st.integers(0, H - 1))
@settings(max_examples=H, deadline=None)
def test_an_action_sees_no_later_action(step):
    torch.manual_seed(step)
    assert moved_steps(transformer(), "action", step) == [i >= step for i in range(H)]


@pytest.mark.parametrize("token", range(C))
def test_an_action_sees_no_later_observation(token):
    """Condition token s is the observation at chunk step s."""
    assert moved_steps(transformer(), "condition", token) == [i >= token for i in range(H)]


@pytest.mark.parametrize("token", range(C))
def test_tokens_that_are_no_history_are_seen_by_all(token):
    assert all(moved_steps(transformer(condition_is_history=False), "condition", token))
    assert all(moved_steps(transformer(causal=False), "condition", token))


def test_without_the_causal_mask_every_action_sees_every_other():
    assert all(all(moved_steps(transformer(causal=False), "action", step)) for step in range(H))


def test_order_matters():
    """Only the learned positions tell two condition tokens apart."""
    net = transformer(causal=False)
    x, k, condition = inputs()
    exchanged = condition.view(B, C, D)[:, [1, 0, 2]].flatten(1)
    nn.init.normal_(net.condition_positions)
    assert not torch.allclose(net(x, k, condition), net(x, k, exchanged))
    nn.init.zeros_(net.condition_positions)
    torch.testing.assert_close(net(x, k, condition), net(x, k, exchanged))


def test_size_of_the_original():
    """Low-dimensional Push-T of arXiv:2303.04137: 20 observed numbers, 2 actions, two observations, horizon 16.

    Table 8 there says 9 M. By hand, W = 256: 8 decoder layers of 8 (W^2 + W) [two attentions] + 8 W^2 + 5 W
    [feed-forward] + 6 W [norms]; embeddings (2 + 1) W and (20 + 1) W; positions (16 + 3) W; the condition's MLP
    8 W^2 + 5 W; the last norm 2 W; the head 2 W + 2.
    """
    w = 256
    layers = 8 * (8 * (w**2 + w) + 8 * w**2 + 5 * w + 6 * w)
    expected = layers + 3 * w + 21 * w + 19 * w + 8 * w**2 + 5 * w + 2 * w + 2 * w + 2
    net = TransformerDenoiser(16, 2, 2, 20, TransformerDenoiserConfig())
    assert sum(parameter.numel() for parameter in net.parameters()) == expected == 8_965_122


def test_initial_weights():
    net = transformer(width=64, n_heads=4)
    matrices = [p for name, p in net.named_parameters() if p.ndim == 2]
    assert torch.cat([p.flatten() for p in matrices]).std().item() == pytest.approx(0.02, rel=0.02)
    for name, parameter in net.named_parameters():
        if name.endswith("bias"):
            assert not parameter.any(), name
        elif parameter.ndim == 1:
            assert torch.equal(parameter, torch.ones_like(parameter)), name  # norms


def test_only_matrices_of_linear_and_attention_layers_decay():
    net = transformer()
    encoder = nn.Sequential(nn.Conv2d(3, 4, 3), nn.BatchNorm2d(4), nn.Embedding(2, 4), nn.Linear(4, 4))
    decaying, others = weight_decay_groups(nn.ModuleList([net, encoder]))
    names = {id(p): n for n, p in nn.ModuleDict({"net": net, "encoder": encoder}).named_parameters()}
    decayed = {names[id(p)] for p in decaying["params"]}
    spared = {names[id(p)] for p in others["params"]}
    assert "weight_decay" not in decaying and others["weight_decay"] == 0
    assert decayed.isdisjoint(spared) and decayed | spared == set(names.values())
    assert {"net.head.weight", "net.decoder.layers.1.self_attn.in_proj_weight", "encoder.3.weight"} <= decayed
    assert {"net.decoder.layers.0.multihead_attn.out_proj.weight"} <= decayed
    assert all(name.endswith("weight") and "norm" not in name for name in decayed)
    assert {
        "net.action_positions",
        "net.condition_positions",
        "encoder.0.weight",
        "encoder.2.weight",
    } <= spared


def test_frozen_parameters_are_not_optimized():
    net = transformer()
    net.head.requires_grad_(False)
    given_ids = {id(p) for group in weight_decay_groups(net) for p in group["params"]}
    assert given_ids == {id(p) for p in net.parameters() if p.requires_grad}


@pytest.mark.parametrize("causal", [True, False])
def test_it_learns_to_denoise(causal):
    """Clean chunks that repeat a number of the first observation: predicting 0 has an error of 1."""
    net = transformer(causal=causal, n_layers=1).train()
    optimizer = torch.optim.AdamW(net.parameters(), lr=1e-2)
    losses = []
    for _ in range(100):
        condition = torch.randn(64, C * D)
        clean = condition[:, :1, None].expand(-1, H, A)
        loss = (net(torch.randn(64, H, A), torch.randint(100, (64,)), condition) - clean).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[0] > 0.7 and max(losses[-10:]) < 0.1


def test_conditions_are_repeated_for_consecutive_actions():
    condition = torch.tensor([[1.0], [2.0]])
    assert torch.equal(repeat_for_actions(condition, {}), condition)
    assert torch.equal(repeat_for_actions(condition, {"action": torch.zeros(2, H, A)}), condition)
    repeated = repeat_for_actions(condition, {"action": torch.zeros(6, H, A)})
    assert repeated.flatten().tolist() == [1, 1, 1, 2, 2, 2]


@pytest.mark.parametrize(
    ("config", "options", "flag"),
    [
        (TransformerDenoiserConfig, {"width": 30, "n_heads": 4}, "--policy.transformer.width .* got 30"),
        (TransformerDenoiserConfig, {"width": 9, "n_heads": 3}, "--policy.transformer.width .* got 9"),
        (TransformerDenoiserConfig, {"n_layers": 0}, "--policy.transformer.n_layers"),
        (TransformerDenoiserConfig, {"n_heads": 0}, "--policy.transformer.n_heads"),
        (TransformerDenoiserConfig, {"dropout": 1.0}, "--policy.transformer.dropout"),
        (TransformerDenoiserConfig, {"attention_dropout": -0.1}, "--policy.transformer.attention_dropout"),
        (MLPDenoiserConfig, {"width": 0}, "--policy.mlp.width"),
        (MLPDenoiserConfig, {"n_blocks": 0}, "--policy.mlp.n_blocks"),
    ],
)
def test_wrong_sizes_are_named(config, options, flag):
    with pytest.raises(FlagError, match=flag):
        config(**options)
