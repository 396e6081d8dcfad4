"""How every command starts, reads its flags, and ends."""

from __future__ import annotations

import logging
import sys
from argparse import ArgumentError
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import wraps
from typing import get_type_hints

import draccus
import torch
from draccus.utils import DraccusException
from lerobot.configs import PreTrainedConfig, parser
from lerobot.envs import EnvConfig
from lerobot.utils.import_utils import register_third_party_plugins
from lerobot.utils.utils import init_logging

from lerobot_agpd.config import StudentConfig, TeacherConfig
from lerobot_agpd.loading import read_policy_config, require_student
from lerobot_agpd.studies.parsing import load_plugins, reason

logger = logging.getLogger(__name__)

WRONG_INPUT = (ValueError, FileNotFoundError, FileExistsError, ModuleNotFoundError, ArgumentError)


def entry_point[C](name: str, positional: str = "") -> Callable[[Callable[[C], None]], Callable[[], None]]:
    """Make a console entry point of a function whose parameter `config` is a dataclass of flags.

    Wrong input ends the command with one line instead of a traceback. `--<field>.discover_packages_path=<package>`
    imports a package that registers types, as in LeRobot's commands; `--<field>.path` is left to the `__post_init__`
    of a dataclass that names the field in `__get_path_fields__`.

    Args:
        name: of the command, as error messages begin.
        positional: flag whose name may be left out before the first word.
    """

    def decorate(function: Callable[[C], None]) -> Callable[[], None]:
        @wraps(function)
        def main() -> None:
            init_logging()
            register_third_party_plugins()
            try:
                args = sys.argv[1:]
                if positional and args and not args[0].startswith("-"):
                    args[0] = f"--{positional}={args[0]}"
                function(_parse(get_type_hints(function)["config"], args))
            except DraccusException as error:  # hides the message of a `__post_init__`
                sys.exit(f"{name}: {reason(error)}")
            except WRONG_INPUT as error:
                logger.debug("the traceback:", exc_info=True)
                sys.exit(f"{name}: {error}")

        return main

    return decorate


def _parse[C](config_class: type[C], args: list[str]) -> C:
    """Parse flags as `lerobot.configs.parser.wrap` does, but raise what is wrong with them."""
    args = load_plugins(args)
    if "--help" in args or "-h" in args:
        parser.print_scoped_help(config_class, args)
        sys.exit(0)
    path_fields: list[str] = getattr(config_class, "__get_path_fields__", list)()
    args = parser.filter_path_args(path_fields, args)
    config_path = parser.parse_arg("config_path", args)
    if config_path:
        config_path = parser.extract_path_fields_from_config(config_path, path_fields)
        args = parser.filter_arg("config_path", args)
    return draccus.parse(config_class=config_class, config_path=config_path, args=args)


def machine_device() -> str:
    """Where policies run if nobody says: this machine's accelerator (CUDA, MPS, ...), else the CPU."""
    accelerator = torch.accelerator.current_accelerator() if torch.accelerator.is_available() else None
    return accelerator.type if accelerator is not None else "cpu"


@dataclass(kw_only=True)
class StudentFlags:
    """A student with the teacher that it was distilled from, and where they act."""

    # Environment to act in.
    env: EnvConfig
    # The student: --policy.path=<checkpoint of a distilled policy>.
    policy: PreTrainedConfig | None = None
    # Flags that are not set are the checkpoint's.
    teacher: TeacherConfig = field(default_factory=TeacherConfig)

    def __post_init__(self) -> None:
        """Read the checkpoint's configuration.

        Raises:
            FlagError: if there is no checkpoint, or it is of another policy.
        """
        path = parser.get_path_arg("policy")
        if path:
            overrides = parser.get_yaml_overrides("policy") + (parser.get_cli_overrides("policy") or [])
            self.policy = read_policy_config(path, "--policy.path", overrides)
        require_student(self.policy)

    @classmethod
    def __get_path_fields__(cls) -> list[str]:
        """Fields whose `.path` the parser leaves to `__post_init__`."""
        return ["policy"]

    @property
    def student(self) -> StudentConfig:
        """The configuration of the student's checkpoint."""
        return require_student(self.policy)
