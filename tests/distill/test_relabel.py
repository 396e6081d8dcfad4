"""Imitating the teacher's own chunks instead of the recorded ones."""

import pytest
import torch

from lerobot_agpd.collect.config import CollectConfig
from lerobot_agpd.distill.config import AdversaryConfig
from lerobot_agpd.guidance.config import TeacherConfig
from lerobot_agpd.policies.agpd.modeling_agpd import AGPDPolicy
from lerobot_agpd.policies.agpd_diffusion.modeling_agpd_diffusion import AGPDDiffusionPolicy
from lerobot_agpd.replay.config import ReplayConfig
from lerobot_agpd.run import RunInfo, declared_run

FRAMES = [0, 4, 6, 12]


@pytest.fixture
def rows_of(demonstrations, save_teacher, loop_batch):
    """The training rows of a student, and the teacher's chunks at them."""

    def rows(policy_class, config, relabel):
        config.teacher = TeacherConfig(path=str(save_teacher()))
        config.collect = CollectConfig(every=0)
        config.adversary = AdversaryConfig(weight=0)
        config.replay = ReplayConfig(relabel=relabel)
        policy = policy_class(
            config, dataset_stats=demonstrations.meta.stats, dataset_meta=demonstrations.meta
        )
        with declared_run(RunInfo()):
            distillation = policy.distillation
            rows = distillation.training_rows(loop_batch(config, FRAMES))
        return rows, distillation

    return rows


def test_recorded_chunks_are_exchanged_for_the_teachers(rows_of, agpd_config):
    recorded, _ = rows_of(AGPDPolicy, agpd_config(chunk_size=20), "none")
    rows, distillation = rows_of(AGPDPolicy, agpd_config(chunk_size=20), "demonstrations")
    chunks, shared = distillation.teacher_chunks.at(rows["agpd.row"], {0, 1, 2})
    assert shared == 15, "the teacher's chunk of 16 steps starts one step in the past"
    assert torch.equal(rows["action"][:, :15], chunks[:, :15])
    assert not torch.allclose(rows["action"][:, :15], recorded["action"][:, :15])
    assert not rows["action_is_pad"][:, :15].any(), "the teacher goes on where the recording ends"
    assert rows["action_is_pad"][:, 15:].all(), "it says nothing of these steps"
    assert torch.equal(rows["observation.state"], recorded["observation.state"])


def test_a_diffusion_student_keeps_its_past_steps(rows_of, agpd_diffusion_config):
    recorded, _ = rows_of(AGPDDiffusionPolicy, agpd_diffusion_config(), "none")
    rows, distillation = rows_of(AGPDDiffusionPolicy, agpd_diffusion_config(), "all")
    chunks, shared = distillation.teacher_chunks.at(rows["agpd.row"], {0, 1, 2})
    assert shared == 7
    assert torch.equal(rows["action"][:, 0], recorded["action"][:, 0]), "the step before now"
    assert torch.equal(rows["action"][:, 1:], chunks)


def test_a_teacher_with_a_shorter_chunk_needs_the_masked_loss(rows_of, agpd_diffusion_config):
    """The teacher's 16 steps are 15 from now on, the student's 24 are 23."""
    message = r"relabel=all.* 15 steps.* has 23.*--policy.do_mask_loss_for_padding=true"
    with pytest.raises(ValueError, match=message):
        rows_of(AGPDDiffusionPolicy, agpd_diffusion_config(horizon=24), "all")
    masked = agpd_diffusion_config(horizon=24, do_mask_loss_for_padding=True)
    rows, _ = rows_of(AGPDDiffusionPolicy, masked, "all")
    assert not rows["action_is_pad"][:, 1:16].any() and rows["action_is_pad"][:, 16:].all()
    rows_of(AGPDDiffusionPolicy, agpd_diffusion_config(horizon=16), "all")  # as long as the teacher's
    rows_of(AGPDDiffusionPolicy, agpd_diffusion_config(horizon=24), "none")  # nothing exchanged


def test_relabelling_needs_a_teacher(demonstrations, agpd_diffusion_config):
    config = agpd_diffusion_config(replay=ReplayConfig(relabel="all"))
    policy = AGPDDiffusionPolicy(config, demonstrations.meta.stats, demonstrations.meta)
    with (
        pytest.raises(ValueError, match=r"--policy.replay.relabel=all needs a teacher"),
        declared_run(RunInfo()),
    ):
        _ = policy.distillation


def test_unknown_relabelling():
    with pytest.raises(ValueError, match=r"--policy.replay.relabel must be one of .*'some'"):
        ReplayConfig(relabel="some")
