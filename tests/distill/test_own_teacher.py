"""Self-distillation: which of a student's selves teaches and which proposes."""

import pytest
import torch
from small_environment import FittingEnv

from lerobot_agpd.collect.config import CollectConfig
from lerobot_agpd.distill.config import AdversaryConfig
from lerobot_agpd.distill.own_teacher import OwnTeacher
from lerobot_agpd.guidance.config import RepresentationConfig, TeacherConfig
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
        loss, none = distillation._adversarial_loss(rows)
        assert loss == 0 and set(none.values()) == {0.0}, "demonstrations alone are not compared with"
        rows["agpd.row"] = torch.tensor([0, 13, 14])  # as if the last two were collected
        kept, chunks, compared = distillation._reference_chunks(rows)
        assert torch.equal(chunks, rows["action"][1:, 1:]) and len(kept["observation.state"]) == 2
        assert torch.equal(compared, ~rows["action_is_pad"][1:, 1:])
        loss, log = distillation._adversarial_loss(rows)
    assert loss.requires_grad and list(log) == list(none), "processes log the same, whatever their rows"


def test_an_adversary_without_anything_to_compare_with_is_refused(student):
    student.config.collect = CollectConfig(every=0)
    with declared_run(RunInfo()), pytest.raises(ValueError, match="adversary.weight=0.05 needs collected"):
        student.distillation  # noqa: B018


def test_an_act_student_cannot_teach_itself(agpd_config):
    with pytest.raises(NotImplementedError, match="'agpd' policy cannot teach itself.*--policy.teacher.path"):
        AGPDPolicy(agpd_config()).snapshot()


def test_the_representation_learns_from_what_was_executed(agpd_diffusion_config, demonstrations, loop_batch):
    """Not from the chunk that is imitated: relabelled actions did not lead to the recorded future."""
    config = agpd_diffusion_config(representation=RepresentationConfig(type="state", width=16, n_heads=2))
    student = AGPDDiffusionPolicy(config, demonstrations.meta.stats, demonstrations.meta)
    config.collect, config.adversary = CollectConfig(every=0), AdversaryConfig(weight=0)
    with declared_run(RunInfo()):
        distillation = student.distillation
        rows = distillation.training_rows(loop_batch(config, [0, 6]))
        loss, _ = distillation._representation_loss(rows)
        relabelled = {**rows, "action": rows["action"] + 1}
        assert distillation._representation_loss(relabelled)[0] == loss
        n_steps = config.n_action_steps
        distillation.replay.table.columns["action"][n_steps - 1] += 1  # the last executed step of row 0
        assert distillation._representation_loss(rows)[0] != loss
        distillation.replay.table.columns["action"][n_steps - 1] -= 1
        distillation.replay.table.columns["action"][n_steps] += 1  # the step after
        torch.testing.assert_close(distillation._representation_loss(rows)[0], loss)


@pytest.mark.parametrize("flag", [{"num_inference_steps": 2}, {"noise_scheduler": "DDPM"}])
def test_settings_of_a_teacher_that_there_is_not_are_refused(student, flag):
    student.config.teacher = TeacherConfig(**flag)
    with declared_run(RunInfo()), pytest.raises(ValueError, match=r"--policy.teacher.*self-distillation"):
        student.distillation  # noqa: B018


@pytest.mark.parametrize(("newest", "doubled"), [(6, True), (8, False)])
def test_the_scale_is_measured_against_the_newest_self(student, newest, doubled, tmp_path, demonstrations):
    """Older selves were worse: 0 of 50 in the first round says nothing about the teacher of this one."""
    student.config.collect = CollectConfig(env=FittingEnv())
    with declared_run(RunInfo(output_dir=tmp_path)):
        distillation = student.distillation
    counts = {"generated": 10, "trivial": 0, "kept": 0}
    distillation.reports = [
        {"guided": counts | {"successful": 0}, "unguided": counts | {"successful": 0}, "next_scale": 1.0}
    ]
    report = {"guided": counts | {"successful": 6}, "unguided": counts | {"successful": newest}}
    distillation.rounds.report = lambda *_: dict(report)
    assert distillation._report(1, 1.0, [], {}, None)["next_scale"] == (2.0 if doubled else 0.5)
