"""Tiny models of LeRobot's own multi_task_dit, pi0, pi05 and smolvla as teachers. Needs transformers."""

import pytest
import torch
from tiny_policies import CAMERA, STATE, WITH_CAMERA, generator, history

from lerobot_agpd.flag_checks import FlagError
from lerobot_agpd.guidance import guide as guidance
from lerobot_agpd.guidance.adapters.flow import MultiTaskDiTTeacher
from lerobot_agpd.guidance.adapters.rtc import RTCTeacher
from lerobot_agpd.guidance.discrepancy import ActionDiscrepancy
from lerobot_agpd.guidance.guide import Guide

pytest.importorskip("transformers", reason="pip install 'lerobot[multi_task_dit,pi,smolvla]'")
pytest.importorskip("num2words", reason="pip install 'lerobot[smolvla]'")

from tiny_vlas import make_multi_task_dit, make_pi, make_smolvla  # noqa: E402

KINDS = ["dit-flow", "dit-rk4", "dit-DDPM", "dit-DDIM", "pi0", "pi05", "smolvla"]
FLOWS = [kind for kind in KINDS if kind not in ("dit-DDPM", "dit-DDIM")]
TARGET = 0.4


@pytest.fixture(scope="module")
def make(tmp_path_factory):
    """Builds teachers by kind; the same kind and options only once."""
    made = {}

    def build(kind, **options):
        key = (kind, *sorted(options.items()))
        if key not in made:
            made[key] = fresh(kind, tmp_path_factory.mktemp("model"), **options)
        return made[key]

    return build


def fresh(kind, folder, **options):
    if kind == "smolvla":
        return make_smolvla(folder, **options)
    if kind.startswith("pi"):
        with pytest.MonkeyPatch.context() as patch:
            return make_pi(kind, patch, **options)
    name = kind.removeprefix("dit-")
    flow = {"objective": "flow_matching", "integration_method": "rk4" if name == "rk4" else "euler"}
    diffusion = {"objective": "diffusion", "noise_scheduler_type": name}
    return make_multi_task_dit(folder, **(flow if kind in FLOWS else diffusion), **options)


def seen(task="push the block", **options) -> dict:
    return history(WITH_CAMERA, task=task, **options)


def pull(teacher, scale, at="x0", **options) -> Guide:
    target = torch.full((len(scale), 3, 2), TARGET)
    return Guide(ActionDiscrepancy(target, teacher.start), torch.tensor(scale), at=at, **options)


def gaps(teacher, actions) -> torch.Tensor:
    """Mean distance of the guided steps to the target, per row."""
    return (teacher.normalize(actions)[:, :3] - TARGET).abs().mean(dim=(1, 2))


def other(observations, key) -> dict:
    """The same history with another current value of one feature."""
    changed = observations[key].clone()
    changed[:, -1] = 1 - changed[:, -1]
    return {**observations, key: changed}


@pytest.mark.parametrize("kind", KINDS)
def test_its_shape(make, kind):
    teacher = make(kind)
    if kind.startswith("dit"):
        assert isinstance(teacher, MultiTaskDiTTeacher)
        assert (teacher.n_obs_steps, teacher.start, teacher.n_chunk_steps) == (2, 1, 7)
    else:
        assert isinstance(teacher, RTCTeacher)
        assert (teacher.n_obs_steps, teacher.start, teacher.n_chunk_steps) == (1, 0, 6)
    assert teacher.n_action_steps == 4 and teacher.needs_task and teacher.resizes_images
    chunk = teacher.sample(seen(), generator=generator())
    assert chunk.shape == (3, teacher.n_chunk_steps, 2) and chunk.isfinite().all()


@pytest.mark.parametrize("kind", KINDS)
def test_the_same_generator_gives_the_same_chunk(make, kind):
    teacher, before = make(kind), torch.get_rng_state()
    source = generator()
    chunk = teacher.sample(seen(), generator=source)
    assert torch.equal(torch.get_rng_state(), before)  # no noise was taken from elsewhere
    assert not torch.equal(teacher.sample(seen(), generator=source), chunk)
    assert torch.equal(teacher.sample(seen(), generator=generator()), chunk)


@pytest.mark.parametrize("kind", KINDS)
def test_everything_it_is_given_matters(make, kind):
    teacher = make(kind)
    chunk = teacher.sample(seen(), generator=generator())
    for changed in (other(seen(), STATE), other(seen(), CAMERA), seen(task="lift the block")):
        assert not torch.equal(teacher.sample(changed, generator=generator()), chunk)


@pytest.mark.parametrize("kind", KINDS)
def test_every_chunk_follows_its_own_instruction(make, kind):
    teacher = make(kind)
    mixed = {**seen(), "task": ["push the block", "lift the block", "push the block"]}
    chunk, pushed, lifted = (
        teacher.sample(given, generator=generator()) for given in (mixed, seen(), seen("lift the block"))
    )
    torch.testing.assert_close(chunk[[0, 2]], pushed[[0, 2]])
    torch.testing.assert_close(chunk[1], lifted[1])


@pytest.mark.parametrize("kind", KINDS)
def test_guidance_approaches_the_student_and_scale_zero_does_nothing(make, kind, monkeypatch):
    monkeypatch.setattr(guidance, "TRUST_REGION", 100.0)
    teacher, steps = make(kind), []
    unguided = teacher.sample(seen(), generator=generator())
    assert torch.equal(teacher.sample(seen(), pull(teacher, [0.0] * 3), generator()), unguided)
    guide = pull(teacher, [0.0, 1.0, 4.0], callback=steps.append)
    guided = teacher.sample(seen(), guide, generator())
    assert torch.equal(guided[0], unguided[0])
    assert (gaps(teacher, guided)[1:] < gaps(teacher, unguided)[1:]).all()
    assert len(guide.shift_in_sigmas) > 0
    assert all(step.shift.shape[-1] == step.x0_hat.shape[-1] == 2 for step in steps)
    torch.testing.assert_close(teacher.sample(seen(), generator=generator()), unguided, rtol=0, atol=0)


@pytest.mark.parametrize("kind", FLOWS)
def test_without_a_trust_region_a_strong_guide_lands_on_the_student(make, kind, monkeypatch):
    monkeypatch.setattr(guidance, "TRUST_REGION", 1e9)
    teacher = make(kind)
    guide = pull(teacher, [1e6] * 3)
    torch.testing.assert_close(
        gaps(teacher, teacher.sample(seen(), guide, generator())),
        torch.zeros(3),
        rtol=0,
        atol=0.2 if kind == "dit-rk4" else 1e-4,  # the last of rk4's four velocities is not guided
    )


@pytest.mark.parametrize("kind", FLOWS)
def test_the_number_of_steps_can_be_set(make, tmp_path, kind):
    teacher, steps = fresh(kind, tmp_path), []
    teacher.set_sampler(3, None)
    teacher.sample(seen(), pull(teacher, [1.0] * 3, callback=steps.append), generator())
    taus = sorted({round(step.timestep, 5) for step in steps})
    euler = [0.0, 0.33333, 0.66667]
    assert taus == (sorted([*euler, 0.16667, 0.5, 0.83333]) if kind == "dit-rk4" else euler)


@pytest.mark.parametrize("kind", ["dit-DDPM", "dit-DDIM"])
def test_a_diffusing_dit_can_exchange_its_scheduler(make, tmp_path, kind):
    teacher, steps = fresh(kind, tmp_path), []
    teacher.set_sampler(5, "DDIM")
    teacher.sample(seen(), pull(teacher, [1.0] * 3, "mu", callback=steps.append), generator())
    assert [step.timestep for step in steps] == [16, 12, 8, 4, 0]
    with pytest.raises(FlagError, match="num_inference_steps=21 exceeds the 20"):
        teacher.set_sampler(21, None)


# ---- refusals ----


@pytest.mark.parametrize("kind", FLOWS)
def test_what_means_nothing_to_a_flow(make, kind):
    teacher = make(kind)
    with pytest.raises(FlagError, match="guidance.at=mu has no meaning.*use --policy.guidance.at=x0"):
        teacher.sample(seen(), pull(teacher, [1.0] * 3, at="mu"))
    with pytest.raises(FlagError, match="guidance.at=mu has no meaning"):
        teacher.require_guidance("mu")
    with pytest.raises(FlagError, match="noise_scheduler=DDIM has no meaning.*integrates a flow"):
        teacher.set_sampler(None, "DDIM")


@pytest.mark.parametrize("kind", ["dit-flow", "pi0", "pi05", "smolvla"])
def test_a_missing_instruction_is_named(make, kind):
    with pytest.raises(KeyError, match="follows instructions.*'task', one string per row"):
        make(kind).sample(history(WITH_CAMERA))


@pytest.mark.parametrize("kind", ["pi0", "pi05", "smolvla"])
def test_empty_cameras_are_not_needed(make, kind):
    teacher = make(kind, empty_cameras=1)
    assert set(teacher.input_features) == set(WITH_CAMERA)
    assert teacher.sample(seen(), generator=generator()).shape == (3, 6, 2)


@pytest.mark.parametrize(("kind", "flag"), [("smolvla", "adapt_to_pi_aloha"), ("pi0", "compile_model")])
def test_variants_that_cannot_be_guided(make, kind, flag):
    teacher = make(kind)
    parts = teacher.policy, teacher._preprocessor, teacher._postprocessor
    with pytest.MonkeyPatch.context() as patch, pytest.raises(FlagError, match=f"has {flag}=true"):
        patch.setattr(teacher.policy.config, flag, True)
        RTCTeacher(*parts)
