"""Whether teacher, student, demonstrations and environment fit together."""

from __future__ import annotations

from collections.abc import Mapping

from lerobot.configs import FeatureType, PolicyFeature
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.envs import EnvConfig
from lerobot.envs.utils import env_to_policy_features
from lerobot.utils.constants import ACTION, OBS_PREFIX
from lerobot.utils.feature_utils import dataset_to_policy_features

from lerobot_agpd.config import StudentConfig
from lerobot_agpd.flag_checks import require
from lerobot_agpd.guidance.teacher import Features, Teacher


def check_fit(
    student: StudentConfig,
    teacher: Teacher | None = None,
    demonstrations: LeRobotDatasetMetadata | None = None,
    env_config: EnvConfig | None = None,
) -> None:
    """Refuse a teacher, demonstrations or an environment that do not belong together; what is None is not checked.

    Raises:
        FlagError: naming both sides and what differs.
    """
    if env_config is not None:
        _check_environment(student, teacher, env_config)
        if demonstrations is not None:
            require(
                env_config.fps == demonstrations.fps,
                f"the demonstrations (--dataset.*) were recorded at {demonstrations.fps} frames per second, the "
                f"environment '{env_config.type}' (--env.fps) runs at {env_config.fps}: T would mix two time scales. Take "
                "demonstrations of the environment's rate; where --env.fps is only declared, give the rate at which it steps",
            )
    if teacher is None:
        return
    if demonstrations is not None:
        _check_observations(
            teacher, "the demonstrations (--dataset.*)", _demonstrated_features(demonstrations)
        )
    elif env_config is not None:
        _check_observations(
            teacher, f"the environment '{env_config.type}' (--env.*)", env_to_policy_features(env_config)
        )
    needed, given = (tuple(feature.shape) for feature in (teacher.action_feature, _action(student)))
    require(
        needed == given,
        f"--policy.teacher.path: the teacher's actions have shape {needed}, the student's {given}; choose a teacher of "
        "the same action space",
    )


def check_teacher(
    teacher: Teacher, demonstrations: LeRobotDatasetMetadata, env_config: EnvConfig | None = None
) -> None:
    """Refuse demonstrations or an environment that a teacher without a student does not belong to.

    Raises:
        FlagError: naming both sides and what differs.
    """
    sources: dict[str, Features] = {
        "the demonstrations (--dataset.*)": dataset_to_policy_features(demonstrations.features)
    }
    if env_config is not None:
        sources[f"the environment '{env_config.type}' (--env.*)"] = env_to_policy_features(env_config)
    needed = tuple(teacher.action_feature.shape)
    for source, features in sources.items():
        _check_observations(teacher, source, features)
        given = tuple(features[ACTION].shape)
        require(
            needed == given,
            f"--policy.teacher.path: the teacher's actions have shape {needed}, those of {source} {given}; choose what "
            "belongs to its task",
        )


def _demonstrated_features(dataset_meta: LeRobotDatasetMetadata) -> Features:
    """Observation features that the demonstrations hold."""
    features = dataset_to_policy_features(dataset_meta.features)
    return {key: feature for key, feature in features.items() if key.startswith(OBS_PREFIX)}


def vectors(features: Features) -> list[str]:
    """Names of the low-dimensional observations among features."""
    return [key for key, ft in features.items() if ft.type in (FeatureType.STATE, FeatureType.ENV)]


def _action(student: StudentConfig) -> PolicyFeature:
    assert student.action_feature is not None
    return student.action_feature


def _check_environment(student: StudentConfig, teacher: Teacher | None, env_config: EnvConfig) -> None:
    """Refuse an environment that does not deliver what student and teacher observe, or takes other actions."""
    delivered = env_to_policy_features(env_config)
    observers: dict[str, Features] = {"student": student.input_features or {}}
    if teacher is not None:
        observers["teacher"] = teacher.input_features
    for observer, inputs in observers.items():
        missing = sorted(set(inputs) - set(delivered))
        require(
            not missing,
            f"the {observer} observes {sorted(inputs)}, the environment '{env_config.type}' delivers "
            f"{sorted(set(delivered) - {ACTION})}: {missing} is missing (check --env.obs_type and --dataset.*)",
        )
    sources: dict[str, Features] = {
        "the demonstrations (--dataset.*)": {**observers["student"], ACTION: _action(student)}
    }
    if teacher is not None:
        sources["the teacher (--policy.teacher.path)"] = teacher.input_features
    for source, features in sources.items():
        for key in [*vectors(features), *([ACTION] if ACTION in features else [])]:
            # Images are left out: environments declare sizes that they do not always deliver.
            needed, given = tuple(features[key].shape), tuple(delivered[key].shape)
            require(
                needed == given,
                f"'{key}' has shape {needed} in {source} and {given} in the environment '{env_config.type}' (--env.*, "
                f"task {env_config.task}), which shows {_shapes(delivered)}",
            )


def _check_observations(teacher: Teacher, source: str, available: Features) -> None:
    """Refuse a teacher whose observations a source does not deliver."""
    differing = sorted(
        key
        for key, feature in teacher.input_features.items()
        if key not in available or not _serves(teacher, feature, available[key])
    )
    require(
        not differing,
        f"the teacher (--policy.teacher.path) needs the observations {_shapes(teacher.input_features)}, {source} "
        f"has {_shapes(available)}; they differ in {differing}",
    )


def _serves(teacher: Teacher, needed: PolicyFeature, given: PolicyFeature) -> bool:
    """Whether a feature is what the teacher needs: of the same shape, or an image that it resizes."""
    if needed.type is FeatureType.VISUAL and teacher.resizes_images:
        return given.type is FeatureType.VISUAL and needed.shape[0] == given.shape[0]  # channels
    return tuple(needed.shape) == tuple(given.shape)


def _shapes(features: Mapping[str, PolicyFeature]) -> dict[str, tuple[int, ...]]:
    return {key: tuple(feature.shape) for key, feature in features.items()}
