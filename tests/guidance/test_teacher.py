"""What all teachers share: history, instructions, spaces, refusals, and the choice of an adapter."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy
from lerobot.processor import RelativeActionsProcessorStep
from lerobot.utils.constants import OBS_IMAGES
from tiny_policies import (
    ACT,
    CAMERA,
    DIFFUSION,
    STATE,
    WITH_CAMERA,
    generator,
    history,
    make_policy,
    make_teacher,
)

from lerobot_agpd.flag_checks import FlagError
from lerobot_agpd.guidance import adapters
from lerobot_agpd.guidance.adapters import adapter_of, as_teacher, register_teacher
from lerobot_agpd.guidance.adapters.chunk import ChunkTeacher
from lerobot_agpd.guidance.adapters.diffusion import DiffusionTeacher
from lerobot_agpd.guidance.adapters.rtc import RTCTeacher
from lerobot_agpd.guidance.discrepancy import ActionDiscrepancy
from lerobot_agpd.guidance.guide import Guide
from lerobot_agpd.guidance.teacher import seeded_by
from lerobot_agpd.policies.agpd.modeling_agpd import AGPDPolicy
from lerobot_agpd.policies.diffusion_transformer.modeling_diffusion_transformer import (
    DiffusionTransformerPolicy,
)

PAGE = Path(__file__).parents[2] / "docs" / "teachers.md"


@pytest.fixture
def registry(monkeypatch):
    """A registry that forgets what the test registers."""
    monkeypatch.setattr(adapters, "_ADAPTERS", dict(adapters._ADAPTERS))


@pytest.fixture(scope="module")
def diffusion():
    return make_teacher(
        "diffusion", WITH_CAMERA, crop_shape=None, pretrained_backbone_weights=None, **DIFFUSION
    )


@pytest.fixture(scope="module")
def act():
    return make_teacher("act", WITH_CAMERA, **ACT)


def pull(batch, target=0.3, scale=1.0, at="x0", start=0) -> Guide:
    return Guide(
        ActionDiscrepancy(torch.full((batch, 2, 2), target), start), torch.full((batch,), scale), at=at
    )


# ---- the choice of an adapter ----


def test_policies_find_their_adapters():
    assert adapter_of(DiffusionPolicy) is DiffusionTeacher
    assert adapter_of(DiffusionTransformerPolicy) is DiffusionTeacher  # through its base class
    assert adapter_of(AGPDPolicy) is ChunkTeacher
    assert DiffusionTeacher.can_be_guided and RTCTeacher.can_be_guided and not ChunkTeacher.can_be_guided


@pytest.mark.slow  # imports LeRobot in a process of its own
def test_adapters_are_imported_when_they_are_needed():
    code = "import sys, lerobot_agpd.guidance.adapters, lerobot_agpd.loading; print(*sys.modules)"
    printed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    imported = printed.stdout.split()
    assert "lerobot_agpd.guidance.adapters" in imported
    assert not [module for module in imported if module.startswith("lerobot_agpd.guidance.adapters.")]


def test_a_registered_adapter_serves_the_type_and_what_is_derived_from_it(registry):
    @register_teacher("act")
    class MyTeacher(ChunkTeacher):
        pass

    policy, *processors = make_policy("act", WITH_CAMERA, **ACT)
    assert type(as_teacher(policy, *processors)) is MyTeacher
    assert adapter_of(AGPDPolicy) is MyTeacher
    assert adapter_of(DiffusionPolicy) is DiffusionTeacher


def test_the_example_of_the_documentation(registry):
    """Ten lines make a VQ-BeT a teacher, with its history of five observations."""
    [example] = re.findall(r"```python\n(.*?)```", PAGE.read_text(), flags=re.DOTALL)
    exec(compile(example, str(PAGE), "exec"), {})
    teacher = make_teacher(
        "vqbet",
        WITH_CAMERA,
        crop_shape=None,
        pretrained_backbone_weights=None,
        gpt_input_dim=16,
        gpt_output_dim=16,
        gpt_hidden_dim=16,
        gpt_n_layer=1,
        gpt_n_head=2,
        spatial_softmax_num_keypoints=4,
    )
    assert type(teacher).__name__ == "VQBeTTeacher"
    seen = history(WITH_CAMERA, length=5)
    chunk = teacher.sample(seen, generator=generator())
    assert chunk.shape == (3, 5, 2) and torch.equal(chunk, teacher.sample(seen, generator=generator()))
    first_changed = {key: value.clone() for key, value in seen.items()}
    first_changed[STATE][:, 0] += 1
    assert not torch.equal(teacher.sample(first_changed, generator=generator()), chunk)


# ---- sampling ----


def test_only_the_last_observations_count(diffusion):
    longer = history(WITH_CAMERA, length=5)
    shorter = {key: value[:, -2:] for key, value in longer.items()}
    chunk = diffusion.sample(longer, generator=generator())
    assert chunk.shape == (3, diffusion.n_chunk_steps, 2)
    assert torch.equal(chunk, diffusion.sample(shorter, generator=generator()))
    older = {key: torch.cat([value[:, :1], value[:, :-1]], dim=1) for key, value in shorter.items()}
    assert not torch.equal(chunk, diffusion.sample(older, generator=generator()))


def test_an_unguided_diffusion_chunk_is_lerobots_own(diffusion):
    """The same noise, LeRobot's own path from normalized observations to unnormalized actions."""
    raw = history(WITH_CAMERA, batch=2)
    batch = {STATE: (raw[STATE] + 1) / 2 - 1}  # MIN_MAX of [-1, 3] to [-1, 1]
    batch[OBS_IMAGES] = ((raw[CAMERA] - 0.5) / 2)[:, :, None]  # MEAN_STD
    model = diffusion.policy.eval().diffusion
    with torch.no_grad():
        condition = model._prepare_global_conditioning(batch)
        chunk = model.conditional_sample(2, global_cond=condition, generator=generator())
    expected = (chunk[:, 1:] + 1) * 2 - 1
    torch.testing.assert_close(diffusion.sample(raw, generator=generator()), expected)


def test_spaces_are_inverse_and_differentiable(diffusion):
    raw = torch.randn(4, 3, 2, requires_grad=True)
    normalized = diffusion.normalize(raw)
    torch.testing.assert_close(normalized, (raw + 1) / 2 - 1)
    torch.testing.assert_close(diffusion.unnormalize(normalized), raw)
    assert torch.autograd.grad(normalized.sum(), raw)[0].allclose(torch.tensor(0.5))


@pytest.mark.parametrize("at", ["x0", "mu"])
def test_a_guided_diffusion_teacher_approaches_the_student(diffusion, at):
    raw, target = history(WITH_CAMERA), 0.3
    unguided = diffusion.sample(raw, generator=generator())
    guided = diffusion.sample(raw, pull(3, target, 2.0, at, diffusion.start), generator())
    gaps = [(diffusion.normalize(x)[:, :2] - target).abs().mean().item() for x in (unguided, guided)]
    assert gaps[1] < gaps[0]
    at_zero = diffusion.sample(raw, pull(3, target, 0.0, at, diffusion.start), generator())
    assert torch.equal(at_zero, unguided)


def test_sampling_leaves_the_policy_as_it_was(diffusion):
    policy = diffusion.policy
    raw, weights = history(WITH_CAMERA), {k: v.clone() for k, v in policy.state_dict().items()}
    evaluated = diffusion.sample(raw, generator=generator())
    policy.train()
    assert torch.equal(diffusion.sample(raw, generator=generator()), evaluated)
    assert policy.training and all(p.requires_grad for p in policy.diffusion.unet.parameters())
    policy.eval()
    assert all(torch.equal(value, weights[key]) for key, value in policy.state_dict().items())


# ---- chunk teachers ----


def test_act_is_asked_about_the_last_observation(act):
    raw = history(WITH_CAMERA, length=3)
    assert (act.start, act.n_obs_steps, act.n_chunk_steps, act.n_action_steps) == (0, 1, 6, 4)
    chunk = act.sample(raw, generator=generator())
    batch = {STATE: (raw[STATE][:, -1] - 0.5) / 2, CAMERA: (raw[CAMERA][:, -1] - 0.5) / 2}
    expected = act.policy.predict_action_chunk(batch) * 2 + 0.5
    torch.testing.assert_close(chunk, expected)


def test_a_student_of_agpd_is_a_chunk_teacher(agpd_config, input_features, output_features):
    from lerobot.policies import make_pre_post_processors
    from tiny_policies import statistics

    config = agpd_config()
    processors = make_pre_post_processors(
        config, dataset_stats=statistics({**input_features, **output_features})
    )
    teacher = as_teacher(AGPDPolicy(config), *processors)
    raw = history(input_features)
    assert type(teacher) is ChunkTeacher and teacher.start == 0
    chunk = teacher.sample(raw)
    assert chunk.shape == (3, config.chunk_size, 2)
    others = {key: torch.cat([value[:, :1] + 1, value[:, 1:]], dim=1) for key, value in raw.items()}
    assert torch.equal(teacher.sample(others), chunk)  # only the current observation counts


def test_a_chunk_teacher_cannot_be_guided(act):
    with pytest.raises(FlagError, match="'act'.*--policy.collect.strategy=teacher"):
        act.sample(history(WITH_CAMERA), pull(3))


def test_a_policy_with_a_history_of_its_own_needs_an_adapter():
    with pytest.raises(FlagError, match="'vqbet' teacher looks at 5 observations.*docs/teachers.md"):
        make_teacher("vqbet", WITH_CAMERA, crop_shape=None, pretrained_backbone_weights=None, gpt_n_layer=1)


# ---- randomness ----


def test_global_randomness_follows_the_generator_and_is_restored():
    torch.manual_seed(1)
    untouched = torch.rand(3)
    torch.manual_seed(1)
    source, draws = generator(5), []
    for _ in range(2):
        with seeded_by(source):
            draws.append(torch.rand(4))
    assert torch.equal(torch.rand(3), untouched)
    assert not torch.equal(*draws)
    with seeded_by(generator(5)):
        assert torch.equal(torch.rand(4), draws[0])
    torch.manual_seed(1)
    with seeded_by(None):
        assert torch.equal(torch.rand(3), untouched)


# ---- refusals ----


def test_what_a_history_can_lack(diffusion):
    raw = history(WITH_CAMERA)
    with pytest.raises(KeyError, match=f"needs .*{CAMERA}.*it was given"):
        diffusion.sample({STATE: raw[STATE]})
    with pytest.raises(ValueError, match="needs 2 observations in a row, it was given 1"):
        diffusion.sample({key: value[:, -1:] for key, value in raw.items()})


@pytest.mark.parametrize(
    ("setting", "flag"), [((5, None), "num_inference_steps=5"), ((None, "DDIM"), "noise_scheduler=DDIM")]
)
def test_act_has_no_sampler_to_set(act, setting, flag):
    act.set_sampler(None, None)
    with pytest.raises(FlagError, match=f"--policy.teacher.{flag} .*'act'"):
        act.set_sampler(*setting)


def test_relative_actions_are_refused():
    policy, preprocessor, postprocessor = make_policy("act", WITH_CAMERA, **ACT)
    preprocessor.steps.insert(0, RelativeActionsProcessorStep(enabled=True))
    with pytest.raises(ValueError, match="relative to the current state.*use_relative_actions=false"):
        as_teacher(policy, preprocessor, postprocessor)


def test_a_teacher_without_a_normalizer_is_refused():
    policy, preprocessor, postprocessor = make_policy("act", WITH_CAMERA, **ACT)
    preprocessor.steps = preprocessor.steps[:1]
    with pytest.raises(ValueError, match="'act' teacher has no normalizer.*RenameObservations"):
        as_teacher(policy, preprocessor, postprocessor)
