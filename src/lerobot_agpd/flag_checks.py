"""How settings that cannot be are refused: by an error whose text reaches the command line."""

from __future__ import annotations

import math
from dataclasses import fields

from diffusers.optimization import SchedulerType
from draccus.utils import ParsingError


class FlagError(ParsingError):
    """A setting that cannot be; of all errors the only kind whose text draccus shows on the command line."""


def require(condition: bool, message: str) -> None:
    """Raise FlagError(message) unless the condition holds."""
    if not condition:
        raise FlagError(message)


def require_finite(group: object, name: str) -> None:
    """Refuse NaN and infinite values among the fields of a group of flags, `--policy.<name>.*`.

    Raises:
        FlagError: naming the flag.
    """
    for entry in fields(group):  # type: ignore[arg-type]  # a dataclass
        value = getattr(group, entry.name)
        require(
            not isinstance(value, float) or math.isfinite(value),
            f"--policy.{name}.{entry.name} must be a finite number, got {value}",
        )


def require_at_least(config: object, least: int, *names: str) -> None:
    """Refuse integers of a policy's configuration, `--policy.<name>`, below a limit; None is allowed.

    Raises:
        FlagError: naming the flag.
    """
    for name in names:
        value = getattr(config, name)
        require(value is None or value >= least, f"--policy.{name} must be at least {least}, got {value}")


def require_scheduler(name: str | None) -> None:
    """Refuse a learning rate schedule that diffusers does not have, or that needs settings of its own.

    Raises:
        FlagError: naming those there are.
    """
    known = [entry.value for entry in SchedulerType if entry is not SchedulerType.PIECEWISE_CONSTANT]
    require(name is None or name in known, f"--policy.scheduler_name must be one of {known}, got '{name}'")
