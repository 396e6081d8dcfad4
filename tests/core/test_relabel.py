"""Imitating the teacher's own chunks instead of the recorded ones."""

import pytest
import torch

from lerobot_agpd.config import AdversaryConfig, CollectConfig, ReplayConfig
from lerobot_agpd.flag_checks import FlagError
from lerobot_agpd.policies.agpd.modeling_agpd import AGPDPolicy
from lerobot_agpd.policies.agpd_diffusion.modeling_agpd_diffusion import AGPDDiffusionPolicy
from lerobot_agpd.replay.replay import FRAME_INDEX

FRAMES = [0, 4, 6, 12]


@pytest.fixture
def train_batch(build, save_teacher, loop_batch):
    """A training batch of a student, and the teacher's chunks at it."""

    def batch(policy_class, config, relabel):
        config.teacher, config.replay = save_teacher(), ReplayConfig(relabel=relabel)
        config.collect, config.adversary = CollectConfig(every=0), AdversaryConfig(weight=0)
        agpd = build(config, policy_class).agpd
        batch = agpd.train_batch(loop_batch(config, FRAMES))
        return batch, agpd.teacher_chunks and agpd.teacher_chunks.at(batch[FRAME_INDEX])

    return batch


def test_recorded_chunks_are_exchanged_for_the_teachers(train_batch, agpd_config):
    recorded, nothing = train_batch(AGPDPolicy, agpd_config(chunk_size=20), "none")
    batch, (chunks, n_shared) = train_batch(AGPDPolicy, agpd_config(chunk_size=20), "demonstrations")
    assert nothing is None and n_shared == 15, "the teacher's chunk of 16 steps starts one step in the past"
    assert torch.equal(batch["action"][:, :15], chunks[:, :15])
    assert not torch.allclose(batch["action"][:, :15], recorded["action"][:, :15])
    assert not batch["action_is_pad"][:, :15].any(), "the teacher goes on where the recording ends"
    assert batch["action_is_pad"][:, 15:].all(), "it says nothing of these steps"
    assert torch.equal(batch["observation.state"], recorded["observation.state"])


def test_a_diffusion_student_keeps_its_past_steps(train_batch, agpd_diffusion_config):
    recorded, _ = train_batch(AGPDDiffusionPolicy, agpd_diffusion_config(), "none")
    batch, (chunks, n_shared) = train_batch(AGPDDiffusionPolicy, agpd_diffusion_config(), "all")
    assert n_shared == 7
    assert torch.equal(batch["action"][:, 0], recorded["action"][:, 0]), "the step before now"
    assert torch.equal(batch["action"][:, 1:], chunks)


def test_a_teacher_with_a_shorter_chunk_needs_the_masked_loss(train_batch, agpd_diffusion_config):
    """The teacher's 16 steps are 15 from now on, the student's 24 are 23."""
    message = r"relabel=all.* 15 steps.* has 23.*--policy.do_mask_loss_for_padding=true"
    with pytest.raises(FlagError, match=message):
        train_batch(AGPDDiffusionPolicy, agpd_diffusion_config(horizon=24), "all")
    masked = agpd_diffusion_config(horizon=24, do_mask_loss_for_padding=True)
    batch, _ = train_batch(AGPDDiffusionPolicy, masked, "all")
    assert not batch["action_is_pad"][:, 1:16].any() and batch["action_is_pad"][:, 16:].all()
    train_batch(AGPDDiffusionPolicy, agpd_diffusion_config(horizon=16), "all")  # as long as the teacher's
    train_batch(AGPDDiffusionPolicy, agpd_diffusion_config(horizon=24), "none")  # nothing exchanged
