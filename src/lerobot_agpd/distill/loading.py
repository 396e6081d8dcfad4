"""A trained student and its teacher from a checkpoint, ready to act together."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from lerobot.configs import PreTrainedConfig, parser
from lerobot.envs import EnvConfig
from lerobot.envs.utils import env_to_policy_features
from lerobot.policies import get_policy_class, make_pre_post_processors
from lerobot.processor import NormalizerProcessorStep

from lerobot_agpd.distill.environment import check_environment_fits
from lerobot_agpd.distill.guided import Proposer
from lerobot_agpd.distill.student import DistilledStudent
from lerobot_agpd.guidance.config import TeacherConfig
from lerobot_agpd.guidance.loading import check_teacher_fits, load_teacher
from lerobot_agpd.guidance.teacher import Teacher
from lerobot_agpd.replay.normalisation import Normaliser


def student_config_from_command_line() -> PreTrainedConfig | None:
    """The configuration of `--policy.path=<checkpoint>`, with the `--policy.*` flags beside it; None without a path.

    Raises:
        ValueError: if the checkpoint is not a policy that was distilled.
    """
    path = parser.get_path_arg("policy")
    if not path:
        return None
    overrides = parser.get_yaml_overrides("policy") + (parser.get_cli_overrides("policy") or [])
    config = PreTrainedConfig.from_pretrained(path, cli_overrides=overrides)
    config.pretrained_path = Path(path)
    return require_student(config)


def require_student(config: PreTrainedConfig | None) -> PreTrainedConfig:
    """Refuse a configuration that names no checkpoint of a distilled policy.

    Raises:
        ValueError: saying which flag is missing or wrong.
    """
    if config is None or not config.pretrained_path:
        raise ValueError(
            "--policy.path is not set: name the checkpoint folder of a policy trained with AGPD "
            "(<output_dir>/checkpoints/last/pretrained_model)"
        )
    if not isinstance(getattr(config, "teacher", None), TeacherConfig):
        raise ValueError(
            f"--policy.path={config.pretrained_path} is a '{config.type}' policy, which has no teacher; name a "
            "policy trained with AGPD (type 'agpd' or another distilled one)"
        )
    return config


def load_student(config: PreTrainedConfig) -> Proposer:
    """Load the checkpoint at `config.pretrained_path`.

    Raises:
        ValueError: if the policy is not a student of AGPD or its checkpoint has no normaliser.
    """
    path = str(config.pretrained_path)
    policy = get_policy_class(config.type).from_pretrained(path, config=config)
    if not isinstance(policy, DistilledStudent):
        raise ValueError(f"--policy.path={path} is a '{config.type}' policy, not a student of AGPD")
    preprocessor, _ = make_pre_post_processors(
        config,
        pretrained_path=path,
        preprocessor_overrides={"device_processor": {"device": config.device}},
    )
    for step in preprocessor.steps:
        if isinstance(step, NormalizerProcessorStep) and step.stats is not None:
            return Proposer(policy.eval(), Normaliser(config, step.stats))
    raise ValueError(f"the preprocessor in --policy.path={path} holds no statistics to normalise with")


def load_pair(
    policy_config: Any, overrides: TeacherConfig, env_config: EnvConfig
) -> tuple[Proposer, Teacher]:
    """A student and the teacher it was distilled from.

    Args:
        policy_config: the student's, with `pretrained_path`.
        overrides: what is set replaces the checkpoint's `teacher.*`.
        env_config: where they are to act.

    Raises:
        ValueError: if teacher, student and environment do not fit together, or the teacher cannot be guided.
    """
    chosen = {key: value for key, value in asdict(overrides).items() if value}
    teacher = load_teacher(replace(policy_config.teacher, **chosen), policy_config.device)
    check_environment_fits(env_config, policy_config, teacher)
    check_teacher_fits(
        teacher,
        env_to_policy_features(env_config),
        policy_config.action_feature,
        policy_config.guidance,
    )
    return load_student(policy_config), teacher
