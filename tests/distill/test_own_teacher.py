"""Self-distillation: which of a student's selves teaches and which proposes."""

import pytest
import torch

from lerobot_agpd.collect.config import CollectConfig
from lerobot_agpd.distill.config import AdversaryConfig
from lerobot_agpd.distill.own_teacher import OwnTeacher
from lerobot_agpd.guidance.config import RepresentationConfig
from lerobot_agpd.policies.agpd.modeling_agpd import AGPDPolicy
from lerobot_agpd.policies.agpd_diffusion.modeling_agpd_diffusion import AGPDDiffusionPolicy
from lerobot_agpd.run import RunInfo, declared_run


@pytest.fixture
def student(agpd_diffusion_config, demonstrations) -> AGPDDiffusionPolicy:
    return AGPDDiffusionPolicy(agpd_diffusion_config(), demonstrations.meta.stats, demonstrations.meta)


def weights(policy) -> torch.Tensor:
    return torch.cat([parameter.detach().flatten() for parameter in policy.diffusion.parameters()])


def move(student, by: float) -> None:
    with torch.no_grad():
        for parameter in student.diffusion.parameters():
            parameter.add_(by)


def test_the_newest_self_teaches_and_the_one_before_proposes(student, demonstrations):
    own = OwnTeacher(student)
    first = weights(student).clone()
    teacher = own.refresh(demonstrations.meta.stats)
    assert own.previous is None, "the first round has no previous self"
    assert torch.equal(weights(teacher.policy), first)
    move(student, 0.1)
    teacher = own.refresh(demonstrations.meta.stats)
    assert torch.equal(weights(own.previous), first)
    assert torch.equal(weights(teacher.policy), weights(student))
    move(student, 0.1)
    assert not torch.equal(weights(teacher.policy), weights(student)), "a round is collected by one policy"


def test_the_previous_self_survives_a_resume(student, demonstrations, tmp_path):
    own = OwnTeacher(student)
    own.refresh(demonstrations.meta.stats)
    saved = weights(student).clone()
    own.save(tmp_path)
    move(student, 0.1)
    resumed = OwnTeacher(student)
    resumed.restore(tmp_path)
    resumed.refresh(demonstrations.meta.stats)
    assert torch.equal(weights(resumed.previous), saved)


def test_nothing_is_restored_where_no_round_was_collected(student, tmp_path):
    own = OwnTeacher(student)
    own.save(tmp_path)
    own.restore(tmp_path)
    assert own.previous is None and not list(tmp_path.iterdir())


def test_its_teacher_speaks_the_students_units(student, demonstrations):
    """Raw actions come out of the statistics that the student trains with."""
    teacher = OwnTeacher(student).refresh(demonstrations.meta.stats)
    low, high = (
        torch.as_tensor(demonstrations.meta.stats["action"][side]).float() for side in ("min", "max")
    )
    torch.testing.assert_close(
        teacher.to_raw(torch.stack([-torch.ones(2), torch.ones(2)])), torch.stack([low, high])
    )


def test_the_adversary_compares_with_executed_chunks_of_collected_rows(student, loop_batch):
    with declared_run(RunInfo()):
        student.config.collect, student.config.adversary = CollectConfig(every=0), AdversaryConfig(weight=0)
        distillation = student.distillation
        student.config.adversary = AdversaryConfig(start=0)
        rows = distillation.training_rows(loop_batch(student.config, [0, 1, 6]))
        assert distillation._adversarial_loss(rows) == (0.0, {}), "demonstrations alone are not compared with"
        rows["agpd.row"] = torch.tensor([0, 13, 14])  # as if the last two were collected
        kept, chunks, compared = distillation._reference_chunks(rows)
        assert torch.equal(chunks, rows["action"][1:, 1:]) and len(kept["observation.state"]) == 2
        assert torch.equal(compared, ~rows["action_is_pad"][1:, 1:])
        loss, log = distillation._adversarial_loss(rows)
    assert loss.requires_grad and "discriminator_accuracy" in log


def test_an_adversary_without_anything_to_compare_with_is_refused(student):
    student.config.collect = CollectConfig(every=0)
    with declared_run(RunInfo()), pytest.raises(ValueError, match="adversary.weight=0.05 needs collected"):
        student.distillation  # noqa: B018


def test_an_act_student_cannot_teach_itself(agpd_config):
    with pytest.raises(NotImplementedError, match="'agpd' policy cannot teach itself.*--policy.teacher.path"):
        AGPDPolicy(agpd_config()).snapshot()


def test_the_representation_learns_from_what_is_executed_now(
    agpd_diffusion_config, demonstrations, loop_batch
):
    """A diffusion student's chunk starts in the past; the step before now does not lead to the future observation."""
    config = agpd_diffusion_config(representation=RepresentationConfig(type="state", width=16, n_heads=2))
    student = AGPDDiffusionPolicy(config, demonstrations.meta.stats, demonstrations.meta)
    config.collect, config.adversary = CollectConfig(every=0), AdversaryConfig(weight=0)
    with declared_run(RunInfo()):
        distillation = student.distillation
        rows = distillation.training_rows(loop_batch(config, [0, 6]))
        loss, _ = distillation._representation_loss(rows)
        past = {**rows, "action": rows["action"].clone()}
        past["action"][:, 0] += 1
        assert distillation._representation_loss(past)[0] == loss
        executed = {**rows, "action": rows["action"].clone()}
        executed["action"][:, config.n_action_steps] += 1  # the last of the executed steps 1 .. n
        assert distillation._representation_loss(executed)[0] != loss
