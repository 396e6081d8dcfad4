"""The environment that collection runs in."""

from __future__ import annotations

from typing import Any

from lerobot.configs import FeatureType
from lerobot.envs import EnvConfig
from lerobot.envs.utils import env_to_policy_features
from lerobot.utils.constants import ACTION

from lerobot_agpd.collect.config import CollectConfig
from lerobot_agpd.guidance.teacher import Teacher
from lerobot_agpd.run import RunInfo


def run_environment(config: CollectConfig, run: RunInfo) -> EnvConfig:
    """The environment to collect in: the policy's own, else the run's.

    Raises:
        ValueError: if there is neither.
    """
    env_config = config.env or run.env
    if env_config is None:
        raise ValueError(
            "collection needs an environment: pass --env.type=... (also used for evaluation) or "
            "--policy.collect.env.type=...; to train without collection pass --policy.collect.every=0"
        )
    return env_config


def check_environment_fits(env_config: EnvConfig, policy_config: Any, teacher: Teacher | None) -> None:
    """Refuse an environment that does not deliver what student and teacher observe, or takes other actions.

    Without a teacher (a student that teaches itself) only the student is checked.

    Raises:
        ValueError: listing both sides.
    """
    delivered = env_to_policy_features(env_config)
    observers = {"student": policy_config.input_features}
    if teacher is not None:
        observers["teacher"] = teacher.input_features
    for who, needed in observers.items():
        missing = sorted(set(needed) - set(delivered))
        if missing:
            raise ValueError(
                f"the {who} observes {sorted(needed)}, the environment '{env_config.type}' delivers "
                f"{sorted(set(delivered) - {ACTION})}: {missing} is missing (check --env.obs_type and the dataset)"
            )
    for key, feature in {**policy_config.input_features, ACTION: policy_config.action_feature}.items():
        # Images are left out: environments declare sizes that they do not always deliver.
        if feature.type is not FeatureType.VISUAL and tuple(delivered[key].shape) != tuple(feature.shape):
            raise ValueError(
                f"'{key}' has shape {tuple(feature.shape)} in the demonstrations and "
                f"{tuple(delivered[key].shape)} in the environment '{env_config.type}' "
                f"(task {env_config.task}): --env.* and --dataset.* do not belong together"
            )
