import pytest
import torch

from lerobot_agpd.guidance.discrepancy import ActionDiscrepancy, StateDiscrepancy
from lerobot_agpd.guidance.representation import StateRepresentation, reconstruction_loss

B, H, N, A, D, START = 3, 6, 2, 2, 4, 1


def to_student(actions):
    return 3 * actions + 0.5


@pytest.fixture
def state_j():
    target = torch.randn(B, N, A)
    return StateDiscrepancy(
        representation=StateRepresentation(D, A, N),
        observation=torch.randn(B, D),
        target=to_student(target),
        to_student=to_student,
        reference=ActionDiscrepancy(target, START),
    )


def test_action_discrepancy_by_hand():
    target = torch.tensor([[[1.0, 2.0], [0.0, -1.0]]])
    chunk = torch.tensor([[[9.0, 9.0], [2.0, 2.0], [3.0, 1.0], [9.0, 9.0]]])
    action_j = ActionDiscrepancy(target, start=1)
    assert action_j(chunk).tolist() == [7.0]  # (1 + 0 + 9 + 4) / 2
    assert action_j.gradient(chunk).tolist() == [[[0, 0], [1, 0], [3, 2], [0, 0]]]


def test_the_closed_form_is_the_gradient():
    """To the last bit: guided chunks do not depend on how the gradient is computed."""
    action_j, chunk = ActionDiscrepancy(torch.randn(B, N, A), START), torch.randn(B, H, A, requires_grad=True)
    (expected,) = torch.autograd.grad(action_j(chunk).sum(), chunk)
    assert torch.equal(action_j.gradient(chunk.detach()), expected)
    assert (expected[:, START : START + N] != 0).all()


def test_gradient_works_under_no_grad_and_leaves_the_chunk_alone(state_j):
    chunk = torch.randn(B, H, A)
    with torch.no_grad():
        grads = [discrepancy.gradient(chunk) for discrepancy in (state_j, state_j.reference)]
    assert not chunk.requires_grad
    assert all(not grad.requires_grad and grad.abs().sum() > 0 for grad in grads)


def test_state_discrepancy_by_hand(state_j):
    """J is the squared distance of the two predicted observations."""
    chunk = torch.randn(B, H, A)
    executed = to_student(chunk[:, START : START + N])
    predict = state_j.representation
    gap = predict(state_j.observation, executed) - predict(state_j.observation, state_j.target)
    torch.testing.assert_close(state_j(chunk), gap.square().sum(dim=1))


def test_state_discrepancy_follows_its_own_gradient(state_j):
    """Up to one factor for the batch."""
    chunk = torch.randn(B, H, A, requires_grad=True)
    (exact,) = torch.autograd.grad(state_j(chunk).sum(), chunk)
    grad, moved = state_j.gradient(chunk.detach()), exact != 0
    factors = grad[moved] / exact[moved]
    torch.testing.assert_close(factors, factors[:1].expand(len(factors)), rtol=1e-3, atol=0)


def test_state_discrepancy_has_the_action_gradients_mean_norm(state_j):
    chunk = torch.randn(B, H, A)
    with torch.no_grad():
        grad = state_j.gradient(chunk)
        reference = state_j.reference.gradient(chunk)
    norms = grad.flatten(1).norm(dim=1)
    torch.testing.assert_close(norms.mean(), reference.flatten(1).norm(dim=1).mean())
    assert norms.std() > 1e-4  # one factor for the batch, not one per row
    assert (grad[:, :START] == 0).all() and (grad[:, START + N :] == 0).all()


def test_a_small_step_against_the_gradient_brings_the_futures_closer(state_j):
    chunk = torch.randn(B, H, A)
    grad = state_j.gradient(chunk)
    closer, now, farther = (state_j(chunk + step * grad) for step in (-1e-2, 0.0, 1e-2))
    assert (closer < now).all() and (now < farther).all()


def test_equal_chunks_have_no_discrepancy(state_j):
    chunk = torch.randn(B, H, A)
    chunk[:, START : START + N] = state_j.reference.target
    for discrepancy in (state_j, state_j.reference):
        assert (discrepancy(chunk) == 0).all() and (discrepancy.gradient(chunk) == 0).all()


def test_representation_gets_no_gradient(state_j):
    state_j.gradient(torch.randn(B, H, A))
    assert all(parameter.grad is None for parameter in state_j.representation.parameters())


def test_reconstruction_loss_ignores_padded_futures():
    predicted = torch.tensor([[1.0, 3.0], [0.0, 0.0], [2.0, 2.0]])
    future = torch.tensor([[0.0, 0.0], [100.0, 100.0], [2.0, 0.0]])
    loss = reconstruction_loss(predicted, future, torch.tensor([False, True, False]))
    assert loss.item() == pytest.approx((5 + 2) / 2)
    assert reconstruction_loss(predicted, future, torch.ones(3, dtype=torch.bool)).item() == 0


def test_representation_predicts_a_change_and_sees_every_step():
    model = StateRepresentation(D, A, N)
    observation, actions = torch.randn(B, D), torch.randn(B, N, A, requires_grad=True)
    predicted = model(observation, actions)
    change = model.decoder(model.encode(observation, actions))
    torch.testing.assert_close(predicted - observation, change.flatten(1))
    predicted.sum().backward()
    assert (actions.grad.abs().sum(dim=2) > 0).all()


@pytest.mark.parametrize("n_tokens", [1, 2])
def test_the_latents_are_the_encoders_first_tokens(n_tokens):
    model = StateRepresentation(2 * D, A, N, n_tokens)
    observation, actions = torch.randn(B, 2 * D), torch.randn(B, N, A)
    observed = model.observation_token(observation.reshape(B, n_tokens, -1))
    whole = model.encoder(torch.cat([observed, model.action_token(actions)], dim=1) + model.position)
    latents = model.to_latent(whole[:, :n_tokens])
    torch.testing.assert_close(model.encode(observation, actions), latents)
