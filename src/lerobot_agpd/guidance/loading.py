"""Load a teacher from a checkpoint, and check that it fits the student and the environment."""

from __future__ import annotations

from pathlib import Path

from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot.policies import get_policy_class, make_pre_post_processors

from lerobot_agpd.guidance.adapters import as_teacher
from lerobot_agpd.guidance.config import GuidanceConfig, TeacherConfig
from lerobot_agpd.guidance.teacher import Features, Teacher


def read_policy_config(path: str, flag: str) -> PreTrainedConfig:
    """Configuration of the checkpoint that a flag names.

    Raises:
        FileNotFoundError: if there is no policy at the path.
    """
    try:
        return PreTrainedConfig.from_pretrained(path)
    except Exception as error:
        raise FileNotFoundError(
            f"{flag}='{path}' is neither a folder with a policy's config.json nor a Hub repository that can be "
            f"reached ({error})"
        ) from error


def load_teacher(config: TeacherConfig, device: str) -> Teacher:
    """Load the teacher that `--policy.teacher.path` names, frozen.

    Raises:
        ValueError: if no path is given, or a setting has no meaning for the policy.
        FileNotFoundError: if there is no policy at the path.
    """
    if not config.path:
        raise ValueError(
            "--policy.teacher.path is not set: AGPD distils a teacher, so name the checkpoint folder or the Hub "
            "repository of a LeRobot policy. To clone the demonstrations alone, pass --policy.collect.every=0 "
            "--policy.adversary.weight=0"
        )
    policy_config = read_policy_config(config.path, "--policy.teacher.path")
    policy_config.device = device
    policy_config.pretrained_path = Path(config.path)
    policy = get_policy_class(policy_config.type).from_pretrained(config.path, config=policy_config)
    preprocessor, postprocessor = make_pre_post_processors(
        policy_config,
        pretrained_path=config.path,
        preprocessor_overrides={"device_processor": {"device": device}},
    )
    teacher = as_teacher(policy.eval().requires_grad_(False), preprocessor, postprocessor)
    teacher.set_sampler(config.num_inference_steps, config.noise_scheduler)
    return teacher


def check_teacher_fits(
    teacher: Teacher, available: Features, action: PolicyFeature, guidance: GuidanceConfig | None = None
) -> None:
    """Refuse a teacher that the observations, the action space or the guidance at hand cannot serve.

    Args:
        teacher: the teacher.
        available: observation features that the demonstrations hold (and the environment delivers).
        action: the student's action feature.
        guidance: how it will be guided; None if it will only be replayed or mixed.

    Raises:
        ValueError: listing both sides.
    """
    wrong = sorted(
        key
        for key, feature in teacher.input_features.items()
        if key not in available or not _accepts(teacher, feature, available[key])
    )
    if wrong:
        needed, given = _shapes(teacher.input_features), _shapes(available)
        raise ValueError(
            f"the teacher (--policy.teacher.path) needs the observations {needed}, the demonstrations hold "
            f"{given}; they differ in {wrong}{_camera_note(teacher.input_features, available)}"
        )
    if tuple(teacher.action_feature.shape) != tuple(action.shape):
        raise ValueError(
            f"the teacher's actions have shape {tuple(teacher.action_feature.shape)}, the demonstrations' "
            f"{tuple(action.shape)}: choose a teacher of the same action space (--policy.teacher.path)"
        )
    if guidance is not None:
        teacher.require_guidance(guidance.at)


def _accepts(teacher: Teacher, needed: PolicyFeature, given: PolicyFeature) -> bool:
    """Whether a feature serves: of the same shape, or an image that the teacher resizes."""
    if needed.type is FeatureType.VISUAL and teacher.resizes_images:
        return given.type is FeatureType.VISUAL and needed.shape[0] == given.shape[0]  # channels
    return tuple(needed.shape) == tuple(given.shape)


def _shapes(features: Features) -> dict[str, tuple[int, ...]]:
    return {key: tuple(feature.shape) for key, feature in features.items()}


def _camera_note(needed: Features, given: Features) -> str:
    """A hint if the numbers of cameras differ; their names may, too."""
    numbers = [sum(ft.type is FeatureType.VISUAL for ft in features.values()) for features in (needed, given)]
    return "" if numbers[0] == numbers[1] else f" (cameras: {numbers[0]} needed, {numbers[1]} held)"
