"""Stage 2 with a real diffusion teacher: what moves in training, when the adversary acts, what it compares."""

from dataclasses import replace

import pytest
import torch
from point_environment import teacher_weights

from lerobot_agpd.config import AdversaryConfig, CollectConfig, ReplayConfig, RepresentationConfig


@pytest.fixture
def policy(build, agpd_config, save_teacher):
    """An ACT student with everything that trains beside it, and no rounds."""
    return build(
        agpd_config(
            teacher=save_teacher(),
            collect=CollectConfig(every=0),
            replay=ReplayConfig(relabel="all"),
            adversary=AdversaryConfig(start=2, every=2),
            representation=RepresentationConfig("state"),
        )
    )


def train(policy, batch, n_steps):
    """A few steps of LeRobot's loop; what they log."""
    optimizer = torch.optim.AdamW(policy.get_optim_params(), lr=1e-3)
    logs = []
    for _ in range(n_steps):
        loss, log = policy.forward(batch)
        loss.backward()
        optimizer.step()
        optimizer.zero_grad()
        policy.update()
        logs.append(log)
    return logs


def test_all_networks_train_but_the_teacher(policy, loop_batch):
    taught, before = (
        teacher_weights(policy.agpd.teacher),
        {k: v.clone() for k, v in policy.state_dict().items()},
    )
    train(policy, loop_batch(policy.config, range(13)), 4)
    assert torch.equal(teacher_weights(policy.agpd.teacher), taught)
    assert not any(parameter.requires_grad for parameter in policy.agpd.teacher.policy.parameters())
    moved = {
        key.split(".")[0] for key, value in policy.state_dict().items() if not torch.equal(value, before[key])
    }
    assert moved == {"model", "discriminator", "representation"}


def test_the_adversary_starts_and_then_acts_every_so_often(policy, loop_batch):
    logs = train(policy, loop_batch(policy.config, range(13)), 7)
    assert ["discriminator_loss" in log for log in logs] == [False, False, True, False, True, False, True]
    assert all({"imitation_loss", "representation_loss", "collected_fraction"} <= set(log) for log in logs)
    assert logs[-1]["grad_norm_student"] > 0 and all(isinstance(x, int | float) for x in logs[-1].values())


def test_steps_that_only_one_of_both_predicts_are_not_compared(policy, loop_batch):
    agpd, discriminator = policy.agpd, policy.discriminator
    agpd.progress.step = 2
    batch = agpd.train_batch(loop_batch(policy.config, [0, 6]))
    whole, prior = agpd.adversary_batch(batch), policy.prior_chunk(batch)
    assert whole.compared.all(), "the teacher's 15 steps cover the student's 8"
    reference = replace(whole, compared=torch.arange(8).expand(2, -1) < 5)

    def loss(reference, prior):
        return agpd.losses(batch, reference, prior, discriminator).log["discriminator_loss"]

    for step, is_compared in ((4, True), (5, False)):
        disturbed = torch.zeros_like(whole.chunk)
        disturbed[:, step] = 1.0
        changed = (
            loss(replace(reference, chunk=reference.chunk + disturbed), prior),
            loss(reference, replace(prior, chunk=prior.chunk + disturbed)),
        )
        assert [value != loss(reference, prior) for value in changed] == [is_compared] * 2


def test_held_out_losses_have_neither_adversary_nor_relabeled_chunks(policy, loop_batch):
    batch = loop_batch(policy.config, [0, 6])
    policy.eval()
    with torch.no_grad():
        loss, log = policy.forward(batch)
    recorded = policy.agpd.replay.eval_batch(batch)
    assert "discriminator_loss" not in log and "action_is_pad" in recorded
    trained_on = policy.train().agpd.train_batch(batch)
    assert torch.isfinite(loss) and not torch.equal(trained_on["action"], recorded["action"])


# ---- training that has become NaN ----


@pytest.mark.parametrize(
    ("part", "loss"),
    [
        ("model", "imitation_loss"),
        ("discriminator", "discriminator_loss"),
        ("representation", "representation_loss"),
    ],
)
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_loss_that_is_not_finite_stops_the_run(policy, loop_batch, part, loss, value):
    batch = loop_batch(policy.config, range(13))
    train(policy, batch, 4)
    with torch.no_grad():
        next(getattr(policy, part).parameters()).fill_(value)
    with pytest.raises(FloatingPointError, match=rf"training step 5: .*{loss}.*weight {part}\.") as stop:
        policy.forward(batch)
    assert ("imitation_loss" in str(stop.value)) == (part == "model")


def test_an_update_that_makes_weights_nan_stops_before_a_checkpoint_is_written(policy, loop_batch):
    """LeRobot saves behind `update`; no forward pass has met these weights yet."""
    batch = loop_batch(policy.config, range(13))
    train(policy, batch, 2)
    optimizer = torch.optim.AdamW(policy.get_optim_params(), lr=1e-3)
    (policy.forward(batch)[0] * float("nan")).backward()
    optimizer.step()
    with pytest.raises(FloatingPointError, match="training step 3 .*weight"):
        policy.update()


def test_a_gradient_scaler_may_skip_an_update(policy, loop_batch):
    batch = loop_batch(policy.config, range(13))
    (policy.forward(batch)[0] * float("inf")).backward()
    policy.zero_grad()
    policy.update()
    assert policy.agpd.progress.step == 1
    train(policy, batch, 1)
