"""Load policies with their processors, and find the environment to collect in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from draccus.utils import DraccusException
from huggingface_hub.constants import CONFIG_NAME
from lerobot.configs import PreTrainedConfig
from lerobot.envs import EnvConfig
from lerobot.policies import PreTrainedPolicy, get_policy_class
from lerobot.processor import NormalizerProcessorStep, PolicyAction, PolicyProcessorPipeline
from lerobot.utils.import_utils import register_third_party_plugins

from lerobot_agpd.config import CollectConfig, StudentConfig, TeacherConfig
from lerobot_agpd.files import read_json
from lerobot_agpd.fit import check_fit
from lerobot_agpd.flag_checks import FlagError, require
from lerobot_agpd.guidance.adapters import as_teacher
from lerobot_agpd.guidance.teacher import Teacher
from lerobot_agpd.replay.gate import not_finite_statistic
from lerobot_agpd.replay.normalization import Normalizer
from lerobot_agpd.run import RunInfo
from lerobot_agpd.student import Student, StudentSampler
from lerobot_agpd.trust import RESTORE, load_processors, require_known_policy, require_safetensors
from lerobot_agpd.weights import not_finite_weight

# ---- policies ----


@dataclass(frozen=True)
class LoadedPolicy:
    """A policy in evaluation mode with the processors of its checkpoint."""

    policy: PreTrainedPolicy
    preprocessor: PolicyProcessorPipeline[dict[str, Any], dict[str, Any]]
    postprocessor: PolicyProcessorPipeline[PolicyAction, PolicyAction]


def read_policy_config(path: str | Path, flag: str, cli_overrides: Sequence[str] = ()) -> PreTrainedConfig:
    """Configuration of the checkpoint that a flag names.

    Args:
        path: checkpoint folder or Hub repository.
        flag: the flag, for messages.
        cli_overrides: arguments that replace settings of the checkpoint, such as `--n_action_steps=4`.

    Raises:
        FileNotFoundError: if there is no policy at the path.
        FlagError: if its configuration holds fields that this version does not have.
        ValueError: if its config.json is damaged.
    """
    register_third_party_plugins()  # the type may be a plugin's, and only LeRobot's commands have done it by now
    if (Path(path) / CONFIG_NAME).is_file():
        read_json(Path(path) / CONFIG_NAME, f"it is what {flag} names; {RESTORE}")
    try:
        config = PreTrainedConfig.from_pretrained(path, cli_overrides=list(cli_overrides))
    except DraccusException as error:
        if isinstance(error, FlagError) and cli_overrides:
            raise
        raise FlagError(
            f"{flag}='{path}': its config.json was written by another version of its policy's package ({error}); load it "
            "with that version, or remove from the file what this version does not have"
        ) from error
    except Exception as error:
        raise FileNotFoundError(
            f"{flag}='{path}' is neither a folder with a policy's config.json nor a Hub repository that can be "
            f"reached ({error}){_inside(path)}"
        ) from error
    config.pretrained_path = Path(path)
    return config


def _inside(path: str | Path) -> str:
    """A hint for those who name the folder of a run instead of one of its checkpoints."""
    inner = ("checkpoints/last/pretrained_model", "last/pretrained_model", "pretrained_model")
    found = next((Path(path) / part for part in inner if (Path(path) / part / CONFIG_NAME).is_file()), None)
    return f"; did you mean '{found}'?" if found else ""


def load_policy(config: PreTrainedConfig) -> LoadedPolicy:
    """Load the checkpoint at `config.pretrained_path` on `config.device`, with the settings of `config`.

    Raises:
        FlagError: if loading it could run a program that it brings along, see `trust`.
        ValueError: naming the file, if one is damaged.
    """
    path = str(config.pretrained_path)
    require_known_policy(config, path)
    processors = load_processors(path, config)
    if Path(path).is_dir():
        require_safetensors(Path(path))
    policy = get_policy_class(config.type).from_pretrained(path, config=config)
    return LoadedPolicy(policy.eval(), *processors)


def load_teacher(config: TeacherConfig, device: str) -> Teacher:
    """Load the teacher that `--policy.teacher.path` names, frozen.

    Raises:
        FlagError: if no path is given, a setting has no meaning for the policy, or its weights are not finite.
        FileNotFoundError: if there is no policy at the path.
    """
    require(
        bool(config.path),
        "--policy.teacher.path is not set: AGPD distills a teacher, so name the checkpoint folder or the Hub "
        "repository of a LeRobot policy. To clone the demonstrations alone, pass --policy.collect.every=0 "
        "--policy.adversary.weight=0",
    )
    policy_config = read_policy_config(config.path, "--policy.teacher.path")
    policy_config.device = device
    loaded = load_policy(policy_config)
    _require_finite_teacher(loaded, config.path)
    teacher = as_teacher(loaded.policy.requires_grad_(False), loaded.preprocessor, loaded.postprocessor)
    teacher.set_sampler(config.num_inference_steps, config.noise_scheduler)
    return teacher


def _require_finite_teacher(loaded: LoadedPolicy, path: str) -> None:
    """Refuse a policy whose weights or statistics hold NaN: every chunk of it would be NaN too."""
    steps = (step for step in loaded.preprocessor.steps if isinstance(step, NormalizerProcessorStep))
    bad = not_finite_weight(loaded.policy)
    for step in steps:
        bad = bad or not_finite_statistic(step.stats or {})
    require(
        bad is None,
        f"--policy.teacher.path='{path}': {bad} is not finite, its training has probably diverged; choose an earlier "
        "checkpoint of it (<output_dir>/checkpoints/<step>/pretrained_model)",
    )


def load_student(config: PreTrainedConfig) -> StudentSampler:
    """Load the distilled policy at `config.pretrained_path`.

    Raises:
        FlagError: if the policy is not a student of AGPD or its checkpoint has no normalizer.
    """
    loaded = load_policy(require_student(config))
    assert isinstance(loaded.policy, Student)
    for step in loaded.preprocessor.steps:
        if isinstance(step, NormalizerProcessorStep) and step.stats is not None:
            return StudentSampler(loaded.policy, Normalizer(config, step.stats))
    raise FlagError(f"the preprocessor in --policy.path={config.pretrained_path} holds no statistics")


def require_student(config: PreTrainedConfig | None) -> StudentConfig:
    """Refuse a configuration that is not that of a distilled policy's checkpoint.

    Raises:
        FlagError: saying which flag is missing or wrong.
    """
    if config is None or not config.pretrained_path:
        raise FlagError(
            "--policy.path is not set: name the checkpoint folder of a policy trained with AGPD "
            "(<output_dir>/checkpoints/last/pretrained_model)"
        )
    if not isinstance(config, StudentConfig):
        raise FlagError(
            f"--policy.path={config.pretrained_path} is a '{config.type}' policy, which has no teacher; name a "
            "policy trained with AGPD (type 'agpd' or another distilled one)"
        )
    return config


def load_pair(
    config: PreTrainedConfig, overrides: TeacherConfig, env_config: EnvConfig
) -> tuple[StudentSampler, Teacher]:
    """A student and the teacher it was distilled from.

    Args:
        config: the student's, with `pretrained_path`.
        overrides: what is set replaces the checkpoint's `teacher.*`.
        env_config: where they are to act.

    Raises:
        FlagError: if teacher, student and environment do not fit together, or the teacher cannot be guided.
    """
    student_config = require_student(config)
    chosen = {key: value for key, value in asdict(overrides).items() if value}
    teacher = load_teacher(replace(student_config.teacher, **chosen), student_config.device or "cpu")
    check_fit(student_config, teacher, env_config=env_config)
    teacher.require_guidance(student_config.guidance.at)
    return load_student(student_config), teacher


# ---- environment ----


def collection_environment(config: CollectConfig, run: RunInfo) -> EnvConfig:
    """The environment to collect in: the policy's own, else the run's.

    Raises:
        FlagError: if there is neither.
    """
    env_config = config.env or run.env
    if env_config is None:
        raise FlagError(
            "collection needs an environment: pass --env.type=... (also used for evaluation) or "
            "--policy.collect.env.type=...; to train without collection pass --policy.collect.every=0"
        )
    return env_config
