"""Settings of `lerobot-train` that make no sense, by the type of policy."""

import types
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from lerobot.configs import PreTrainedConfig
from lerobot.envs import EnvConfig

from lerobot_agpd.config import StudentConfig

WRONG = {
    float: ("nan", "inf", "-inf", "much"),
    int: ("some", "1.5", "nan"),
    bool: ("perhaps",),
}
HINTS = get_type_hints(StudentConfig)
GROUPS = {name for name in set(HINTS) - set(get_type_hints(PreTrainedConfig)) if is_dataclass(HINTS[name])}

OUT_OF_RANGE: dict[str, tuple[float | str, ...]] = {
    "teacher.num_inference_steps": (0, -3),
    "guidance.pull": (-0.1, 1.5),
    "guidance.scale": (-1,),
    "guidance.max_pull": (0, -1, 2),
    "guidance.max_scale": (0, -1),
    "collect.nearest_samples": (1, 0, -2),
    "collect.mixing.weight": (-0.1, 1.1),
    "collect.warmup": (0, -1),
    "collect.every": (-1,),
    "collect.rounds": (-1,),
    "collect.episodes": (0, -50),
    "collect.n_envs": (0, -1),
    "collect.step_timeout": (0, -60),
    "collect.max_episode_steps": (0, -1),
    "collect.teacher_only_fraction": (-0.1, 1.1),
    "collect.retry_fraction": (-0.1, 1.1),
    "collect.n_action_steps": (0, -1, 10_000),
    "collect.repo_id": ("a/b/c", "-me/x", "me/x--y", "a" * 97),
    "replay.collected_fraction": (-0.1, 1, 1.5),
    "adversary.weight": (-0.1,),
    "adversary.every": (0, -1),
    "adversary.start": (-1,),
    "adversary.lr": (0, -1e-4),
    "scheduler_name": ("nope", "piecewise_constant"),
    "scheduler_warmup_steps": (-1,),
}
"""Values of a student's flags beyond their limits."""

COUNTS = ("num_train_timesteps", "num_inference_steps", "n_obs_steps", "horizon", "n_action_steps")
DIFFUSION = ("agpd_diffusion", "diffusion_transformer", "act_diffusion")


def kinds(annotation: Any) -> list[Any]:
    """The plain types, and choices, that a field's annotation allows."""
    if get_origin(annotation) in (Union, types.UnionType):
        return [kind for part in get_args(annotation) for kind in kinds(part)]
    return ["choice"] if get_origin(annotation) is Literal else [annotation]


def of_wrong_type(group: type, prefix: str) -> Iterator[str]:
    """Every field of a group of flags, and of the groups inside, with values that it cannot have."""
    hints = get_type_hints(group)
    for entry in fields(group):
        allowed, flag = kinds(hints[entry.name]), f"{prefix}{entry.name}"
        if is_dataclass(allowed[0]) and not issubclass(allowed[0], EnvConfig):  # type: ignore[arg-type]
            yield from of_wrong_type(allowed[0], f"{flag}.")
        elif "choice" in allowed:
            yield f"{flag}=none_of_these"
        else:
            yield from (f"{flag}={value}" for kind in allowed for value in WRONG.get(kind, ()))


def of_wrong_types() -> list[tuple[str, str]]:
    """Type of policy, and a setting that is no number or choice: a student's groups, counts of diffusion policies."""
    groups = [setting for name in sorted(GROUPS) for setting in of_wrong_type(HINTS[name], f"{name}.")]
    counts = [f"{flag}={value}" for flag in COUNTS for value in ("some", "1.5")]
    return [
        *(("agpd", setting) for setting in groups),
        *((name, setting) for name in DIFFUSION for setting in counts),
    ]


def out_of_range() -> list[tuple[str, str]]:
    """Type of policy, and a setting beyond a limit."""
    found = [("agpd", f"{flag}={value}") for flag, values in OUT_OF_RANGE.items() for value in values]
    counts = [(name, f"{flag}={value}") for name in DIFFUSION for flag in COUNTS for value in (0, -4)]
    return [*found, *counts]


def all_wrong_settings() -> list[tuple[str, str]]:
    """Type of policy, and a setting that makes no sense."""
    return [*of_wrong_types(), *out_of_range()]
