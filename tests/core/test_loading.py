"""Policies from checkpoints: a loaded teacher acts as before, and so does a loaded student."""

from types import SimpleNamespace

import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies import make_pre_post_processors
from point_environment import PointEnv
from tiny_policies import (
    ACT,
    ACTIONS,
    CAMERA,
    DIFFUSION,
    STATE,
    WITH_CAMERA,
    generator,
    history,
    make_policy,
    make_teacher,
)

from lerobot_agpd.config import GuidanceConfig, TeacherConfig
from lerobot_agpd.fit import check_fit
from lerobot_agpd.flag_checks import FlagError
from lerobot_agpd.guidance.adapters.chunk import ChunkTeacher
from lerobot_agpd.guidance.adapters.diffusion import DiffusionTeacher
from lerobot_agpd.loading import (
    load_pair,
    load_student,
    load_teacher,
    read_policy_config,
    require_student,
)
from lerobot_agpd.policies.agpd.modeling_agpd import AGPDPolicy
from lerobot_agpd.weights import not_finite_weight

VISION = {"crop_shape": None, "pretrained_backbone_weights": None, **DIFFUSION}


@pytest.fixture(scope="module")
def save(tmp_path_factory):
    """Writes a checkpoint of a policy with its processors."""

    def write(policy_type, **options) -> str:
        folder = tmp_path_factory.mktemp("checkpoint") / policy_type
        for part in make_policy(policy_type, WITH_CAMERA, **options):
            part.save_pretrained(folder)
        return str(folder)

    return write


@pytest.fixture(scope="module")
def diffusion_path(save):
    return save("diffusion", **VISION)


@pytest.fixture(scope="module")
def act_path(save):
    return save("act", **ACT)


@pytest.fixture(scope="module")
def diffusion():
    return make_teacher("diffusion", WITH_CAMERA, **VISION)


def test_a_loaded_diffusion_teacher_samples_as_before(diffusion_path, diffusion):
    teacher = load_teacher(TeacherConfig(path=diffusion_path), "cpu")
    assert type(teacher) is DiffusionTeacher and not teacher.policy.training
    assert not any(p.requires_grad for p in teacher.policy.parameters())
    raw = history(WITH_CAMERA)
    expected = diffusion.sample(raw, generator=generator())
    assert torch.equal(teacher.sample(raw, generator=generator()), expected)


def test_a_loaded_act_teacher_samples_as_before(act_path):
    teacher, act = load_teacher(TeacherConfig(path=act_path), "cpu"), make_teacher("act", WITH_CAMERA, **ACT)
    assert type(teacher) is ChunkTeacher
    torch.testing.assert_close(teacher.sample(history(WITH_CAMERA)), act.sample(history(WITH_CAMERA)))


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_teacher_with_weights_that_are_not_finite(tmp_path, value):
    policy, *processors = make_policy("act", WITH_CAMERA, **ACT)
    name, parameter = list(policy.named_parameters())[-1]
    with torch.no_grad():
        parameter[0] = value
    for part in (policy, *processors):
        part.save_pretrained(tmp_path)
    with pytest.raises(FlagError, match=rf"--policy.teacher.path='{tmp_path}': {name} is not finite"):
        load_teacher(TeacherConfig(path=str(tmp_path)), "cpu")


def test_a_teacher_with_statistics_that_are_not_finite(tmp_path):
    policy, *processors = make_policy("act", WITH_CAMERA, **ACT)
    policy.save_pretrained(tmp_path)
    for processor in processors:
        for step in processor.steps:
            if stats := getattr(step, "_tensor_stats", None):
                stats["action"]["std"][1] = float("nan")
        processor.save_pretrained(tmp_path)
    with pytest.raises(FlagError, match="'std' of 'action' is not finite"):
        load_teacher(TeacherConfig(path=str(tmp_path)), "cpu")


def test_a_mask_of_infinite_values_is_no_broken_weight():
    model = torch.nn.Linear(2, 2)
    model.register_buffer("mask", torch.tensor([0.0, -float("inf")]))
    assert not_finite_weight(model) is None
    model.mask[0] = float("nan")
    assert not_finite_weight(model) == "mask"


def test_chunks_that_are_not_finite_are_refused_when_sampled(act_path):
    teacher, raw = load_teacher(TeacherConfig(path=act_path), "cpu"), history(WITH_CAMERA)
    teacher.sample(raw)
    raw[STATE][1] = float("nan")
    with pytest.raises(FloatingPointError, match="'act' teacher.*--policy.teacher.path"):
        teacher.sample(raw)


def test_settings_of_the_sampler_act(diffusion_path):
    chosen = TeacherConfig(path=diffusion_path, num_inference_steps=3, noise_scheduler="DDIM")
    model = load_teacher(chosen, "cpu").policy.diffusion
    assert type(model.noise_scheduler).__name__ == "DDIMScheduler" and model.num_inference_steps == 3
    with pytest.raises(FlagError, match="num_inference_steps=21 exceeds the 20"):
        load_teacher(TeacherConfig(path=diffusion_path, num_inference_steps=21), "cpu")


def test_settings_without_meaning_are_refused(act_path):
    with pytest.raises(FlagError, match="--policy.teacher.num_inference_steps=3 .*'act'"):
        load_teacher(TeacherConfig(path=act_path, num_inference_steps=3), "cpu")


def test_a_teacher_must_be_named():
    with pytest.raises(FlagError, match="--policy.teacher.path"):
        load_teacher(TeacherConfig(), "cpu")


# ---- students ----


@pytest.fixture
def student(agpd_config, save_teacher, demonstrations, tmp_path):
    """A saved student of the small teacher, as its checkpoint's configuration, and the policy itself."""
    policy = AGPDPolicy(agpd_config(teacher=save_teacher(), guidance=GuidanceConfig(at="mu"))).eval()
    folder = tmp_path / "student"
    policy.save_pretrained(folder)
    for processor in make_pre_post_processors(policy.config, dataset_stats=demonstrations.meta.stats):
        processor.save_pretrained(folder)
    return read_policy_config(folder, "--policy.path"), policy


def raw_history(demonstrations):
    frames = [demonstrations[n] for n in range(4)]
    keys = ("observation.state", "observation.environment_state")
    return {key: torch.stack([frame[key] for frame in frames])[:, None] for key in keys}


def test_a_loaded_student_proposes_as_before(student, demonstrations):
    config, policy = student
    raw, (preprocess, _) = (
        raw_history(demonstrations),
        make_pre_post_processors(config, dataset_stats=demonstrations.meta.stats),
    )
    expected = policy.predict_action_chunk(preprocess({key: value[:, -1] for key, value in raw.items()}))
    sampler = load_student(config)
    chunk = sampler.propose(raw)
    torch.testing.assert_close(chunk, expected)
    assert sampler.config.guidance.at == "mu" and not sampler.student.training


def test_a_pair_is_the_student_with_the_teacher_it_was_distilled_from(student):
    sampler, teacher = load_pair(student[0], TeacherConfig(num_inference_steps=3), PointEnv())
    assert teacher.policy.diffusion.num_inference_steps == 3
    pair = sampler.pair_with(teacher)
    assert pair.n_steps == 4 and pair.n_obs_steps == teacher.n_obs_steps == 2


def test_what_is_not_a_student_is_refused(act_path):
    with pytest.raises(FlagError, match="--policy.path is not set"):
        require_student(None)
    with pytest.raises(FlagError, match="--policy.path=.* is a 'act' policy"):
        load_student(read_policy_config(act_path, "--policy.path"))


# ---- cameras ----


@pytest.fixture
def filmed_config(agpd_config):
    return agpd_config(
        input_features=dict(WITH_CAMERA), output_features=dict(ACTIONS), pretrained_backbone_weights=None
    )


def demonstrations_with(features) -> SimpleNamespace:
    """Metadata of demonstrations with these observations."""
    entries = {
        key: {"dtype": "image", "shape": ft.shape, "names": ["channels", "height", "width"]}
        if ft.type is FeatureType.VISUAL
        else {"dtype": "float32", "shape": ft.shape, "names": None}
        for key, ft in features.items()
    }
    return SimpleNamespace(fps=10, features=entries)


def camera(*shape):
    return demonstrations_with({**WITH_CAMERA, CAMERA: PolicyFeature(FeatureType.VISUAL, shape)})


def test_more_observations_than_the_teacher_needs_fit(filmed_config, diffusion):
    more = {**WITH_CAMERA, "observation.effort": PolicyFeature(FeatureType.STATE, (7,))}
    check_fit(filmed_config, diffusion, demonstrations_with(more))


def test_a_missing_camera(filmed_config, diffusion):
    with pytest.raises(FlagError, match=rf"differ in \['{CAMERA}'\]"):
        check_fit(filmed_config, diffusion, demonstrations_with({STATE: WITH_CAMERA[STATE]}))


def test_images_must_have_the_teachers_size_unless_it_resizes_them(filmed_config, diffusion):
    with pytest.raises(FlagError, match=r"\(3, 64, 64\).*\(3, 80, 96\).*differ in"):
        check_fit(filmed_config, diffusion, camera(3, 80, 96))
    resizing = make_teacher("diffusion", WITH_CAMERA, resize_shape=(64, 64), **VISION)
    check_fit(filmed_config, resizing, camera(3, 80, 96))
    larger = {**WITH_CAMERA, CAMERA: PolicyFeature(FeatureType.VISUAL, (3, 80, 96))}
    resized = resizing.sample(history(larger), generator=generator())
    assert resized.shape == (3, resizing.n_chunk_steps, 2)
    with pytest.raises(FlagError, match=r"\(1, 80, 96\).*differ in"):
        check_fit(filmed_config, resizing, camera(1, 80, 96))
