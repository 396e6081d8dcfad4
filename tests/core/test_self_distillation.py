"""Self-distillation: which of a student's selves teaches and which proposes."""

import pytest
import torch
from point_environment import PointEnv, teacher_weights

from lerobot_agpd.config import (
    AdversaryConfig,
    CollectConfig,
    ReplayConfig,
    RepresentationConfig,
    TeacherConfig,
)
from lerobot_agpd.flag_checks import FlagError
from lerobot_agpd.policies.agpd.modeling_agpd import AGPDPolicy
from lerobot_agpd.policies.agpd_diffusion.modeling_agpd_diffusion import AGPDDiffusionPolicy
from lerobot_agpd.replay.replay import FRAME_INDEX
from lerobot_agpd.self_distillation import SelfTeacher

NO_ROUNDS, NO_ADVERSARY = CollectConfig(every=0), AdversaryConfig(weight=0)


@pytest.fixture
def student(agpd_diffusion_config) -> AGPDDiffusionPolicy:
    return AGPDDiffusionPolicy(agpd_diffusion_config())


@pytest.fixture
def stats(demonstrations):
    return demonstrations.meta.stats


def weights(policy) -> torch.Tensor:
    return torch.cat([parameter.detach().flatten() for parameter in policy.diffusion.parameters()])


def move(student, by: float) -> None:
    with torch.no_grad():
        for parameter in student.diffusion.parameters():
            parameter.add_(by)


def test_the_newest_self_teaches_and_the_one_before_proposes(student, stats):
    own, first = SelfTeacher(student), weights(student).clone()
    teacher = own.refresh(stats)
    assert own.previous is None, "the first round has no previous self"
    assert torch.equal(weights(teacher.policy), first)
    move(student, 0.1)
    teacher = own.refresh(stats)
    assert torch.equal(weights(own.previous), first)
    assert torch.equal(weights(teacher.policy), weights(student))
    taught = teacher_weights(teacher)
    move(student, 0.1)
    assert torch.equal(teacher_weights(teacher), taught), "a round is collected by one policy"


def test_the_previous_self_survives_a_resume(student, stats, tmp_path):
    own = SelfTeacher(student)
    own.save(tmp_path)
    own.restore(tmp_path)
    assert own.previous is None and not list(tmp_path.iterdir()), "no round was collected"
    own.refresh(stats)
    saved = weights(student).clone()
    own.save(tmp_path)
    move(student, 0.1)
    resumed = SelfTeacher(student)
    resumed.restore(tmp_path)
    resumed.refresh(stats)
    assert torch.equal(weights(resumed.previous), saved)


def test_its_teacher_acts_in_the_students_space(student, stats):
    """Raw actions come out of the statistics that the student trains with."""
    teacher = SelfTeacher(student).refresh(stats)
    ends = torch.stack([torch.as_tensor(stats["action"][side]).float() for side in ("min", "max")])
    unnormalized = teacher.unnormalize(torch.tensor([[-1.0, -1.0], [1.0, 1.0]]))
    torch.testing.assert_close(unnormalized, ends)


def test_the_adversary_compares_with_executed_chunks_of_collected_frames(
    build, agpd_diffusion_config, loop_batch
):
    config = agpd_diffusion_config(collect=NO_ROUNDS, adversary=NO_ADVERSARY)
    agpd = build(config, AGPDDiffusionPolicy).agpd
    config.adversary = AdversaryConfig(start=0)
    batch = agpd.train_batch(loop_batch(config, [0, 1, 6]))
    assert len(agpd.adversary_batch(batch).chunk) == 0, "demonstrations alone are not compared with"
    first = agpd.replay.n_demonstration_frames
    batch[FRAME_INDEX] = torch.tensor([0, first, first + 1])  # as if the last two were collected
    reference = agpd.adversary_batch(batch)
    assert torch.equal(reference.chunk, batch["action"][1:, 1:])
    assert len(reference.batch["observation.state"]) == 2
    assert torch.equal(reference.compared, ~batch["action_is_pad"][1:, 1:])


def test_every_process_logs_the_same_keys(build, agpd_diffusion_config, loop_batch):
    """LeRobot averages what is logged by position, and a batch may hold no collected frame."""
    config = agpd_diffusion_config(collect=NO_ROUNDS, adversary=NO_ADVERSARY)
    policy = build(config, AGPDDiffusionPolicy)
    agpd, batch = policy.agpd, loop_batch(config, [0, 1, 6])
    config.adversary = AdversaryConfig(start=0)
    batch = agpd.train_batch(batch)
    without = agpd.losses(batch, agpd.adversary_batch(batch), None, None)
    batch[FRAME_INDEX] = batch[FRAME_INDEX] + agpd.replay.n_demonstration_frames
    reference = agpd.adversary_batch(batch)
    discriminator = AGPDDiffusionPolicy(config).discriminator
    with_them = agpd.losses(batch, reference, policy.prior_chunk(reference.batch), discriminator)
    assert list(with_them.log) == list(without.log)
    assert without.log["discriminator_loss"] == 0 < with_them.log["discriminator_loss"]
    assert without.total == 0 and with_them.total.requires_grad


def test_the_representation_learns_from_what_was_executed(build, agpd_diffusion_config, loop_batch):
    """Not from the chunk that is imitated: relabeled actions did not lead to the recorded future."""
    config = agpd_diffusion_config(
        collect=NO_ROUNDS, adversary=NO_ADVERSARY, representation=RepresentationConfig("state")
    )
    agpd = build(config, AGPDDiffusionPolicy).agpd
    batch = agpd.train_batch(loop_batch(config, [0, 6]))

    def recon(batch):
        return agpd.losses(batch, None, None, None).log["representation_loss"]

    before, recorded = recon(batch), agpd.replay.table.columns["action"]
    assert recon({**batch, "action": batch["action"] + 1}) == before
    last = config.n_action_steps - 1
    recorded[last] += 1  # the last executed step of frame 0
    assert recon(batch) != before
    recorded[last] -= 1
    recorded[last + 1] += 1  # the step after
    assert recon(batch) == pytest.approx(before)


# ---- refusals ----


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"teacher": TeacherConfig(num_inference_steps=2)}, "--policy.teacher.num_inference_steps=2"),
        ({"teacher": TeacherConfig(noise_scheduler="DDPM")}, "--policy.teacher.noise_scheduler=DDPM"),
        ({"replay": ReplayConfig(relabel="all")}, "--policy.replay.relabel=all needs a teacher"),
        ({"collect": NO_ROUNDS}, "--policy.adversary.weight=0.05 needs collected episodes"),
    ],
)
def test_settings_that_mean_nothing_in_self_distillation(build, agpd_diffusion_config, options, message):
    config = agpd_diffusion_config(**{"collect": CollectConfig(env=PointEnv()), **options})
    with pytest.raises(FlagError, match=message):
        build(config, AGPDDiffusionPolicy)


def test_an_act_student_cannot_teach_itself(agpd_config):
    with pytest.raises(NotImplementedError, match="'agpd'.*--policy.teacher.path"):
        AGPDPolicy(agpd_config()).snapshot()
