"""Teachers from checkpoints, and what does not fit."""

import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
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

from lerobot_agpd.guidance.adapters.chunk import ChunkTeacher
from lerobot_agpd.guidance.adapters.diffusion import DiffusionTeacher
from lerobot_agpd.guidance.config import GuidanceConfig, TeacherConfig
from lerobot_agpd.guidance.loading import check_teacher_fits, load_teacher

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
def diffusion():
    return make_teacher("diffusion", WITH_CAMERA, **VISION)


@pytest.fixture(scope="module")
def act():
    return make_teacher("act", WITH_CAMERA, **ACT)


def test_a_loaded_diffusion_teacher_samples_as_before(diffusion_path, diffusion):
    teacher = load_teacher(TeacherConfig(path=diffusion_path), "cpu")
    assert type(teacher) is DiffusionTeacher and not teacher.policy.training
    assert not any(p.requires_grad for p in teacher.policy.parameters())
    raw = history(WITH_CAMERA)
    expected = diffusion.sample(raw, generator=generator())
    assert torch.equal(teacher.sample(raw, generator=generator()), expected)


def test_a_loaded_act_teacher_samples_as_before(save, act):
    teacher = load_teacher(TeacherConfig(path=save("act", **ACT)), "cpu")
    assert type(teacher) is ChunkTeacher
    torch.testing.assert_close(teacher.sample(history(WITH_CAMERA)), act.sample(history(WITH_CAMERA)))


def test_settings_of_the_sampler_act(diffusion_path):
    chosen = TeacherConfig(path=diffusion_path, num_inference_steps=3, noise_scheduler="DDIM")
    model = load_teacher(chosen, "cpu").policy.diffusion
    assert type(model.noise_scheduler).__name__ == "DDIMScheduler" and model.num_inference_steps == 3
    with pytest.raises(ValueError, match="num_inference_steps=21 exceeds the 20"):
        load_teacher(TeacherConfig(path=diffusion_path, num_inference_steps=21), "cpu")


def test_settings_without_meaning_are_refused(save):
    with pytest.raises(ValueError, match="teacher.num_inference_steps=3 has no meaning for this 'act'"):
        load_teacher(TeacherConfig(path=save("act", **ACT), num_inference_steps=3), "cpu")


def test_no_checkpoint(tmp_path):
    with pytest.raises(ValueError, match="--policy.teacher.path is not set"):
        load_teacher(TeacherConfig(), "cpu")
    with pytest.raises(FileNotFoundError, match="--policy.teacher.path=.*neither a folder"):
        load_teacher(TeacherConfig(path=str(tmp_path)), "cpu")


# ---- what does not fit ----


def test_what_fits(diffusion, act):
    more = {**WITH_CAMERA, "observation.effort": PolicyFeature(FeatureType.STATE, (7,))}
    for at in ("x0", "mu"):
        check_teacher_fits(diffusion, more, ACTIONS["action"], GuidanceConfig(at=at))
    check_teacher_fits(act, more, ACTIONS["action"])


def test_a_missing_camera_is_counted(diffusion):
    with pytest.raises(ValueError, match=rf"\['{CAMERA}'\] \(cameras: 1 needed, 0 held\)"):
        check_teacher_fits(diffusion, {STATE: WITH_CAMERA[STATE]}, ACTIONS["action"])


def test_images_must_have_the_size_unless_they_are_resized(diffusion):
    larger = {**WITH_CAMERA, CAMERA: PolicyFeature(FeatureType.VISUAL, (3, 80, 96))}
    with pytest.raises(ValueError, match=r"\(3, 64, 64\).*\(3, 80, 96\).*they differ in"):
        check_teacher_fits(diffusion, larger, ACTIONS["action"])
    resizing = make_teacher("diffusion", WITH_CAMERA, resize_shape=(64, 64), **VISION)
    check_teacher_fits(resizing, larger, ACTIONS["action"])
    resized = resizing.sample(history(larger), generator=generator())
    assert resized.shape == (3, resizing.n_chunk_steps, 2)
    depth = {**WITH_CAMERA, CAMERA: PolicyFeature(FeatureType.VISUAL, (1, 80, 96))}
    with pytest.raises(ValueError, match="they differ in"):
        check_teacher_fits(resizing, depth, ACTIONS["action"])


def test_other_actions(act):
    with pytest.raises(ValueError, match=r"actions have shape \(2,\), the demonstrations' \(3,\)"):
        check_teacher_fits(act, WITH_CAMERA, PolicyFeature(FeatureType.ACTION, (3,)))


def test_guidance_of_a_policy_that_does_not_denoise(act):
    with pytest.raises(ValueError, match="'act' teacher predicts its chunk in one pass"):
        check_teacher_fits(act, WITH_CAMERA, ACTIONS["action"], GuidanceConfig())
