"""Parse flags and environments as LeRobot's commands do, plugins included."""

from __future__ import annotations

import io
import logging
import re
from collections.abc import Mapping, Sequence
from contextlib import redirect_stderr
from typing import Any

import draccus
from draccus.utils import ParsingError
from lerobot.configs import parser
from lerobot.configs.train import TrainPipelineConfig
from lerobot.envs import EnvConfig

PLUGIN = parser.PLUGIN_DISCOVERY_SUFFIX
WRAPPER = re.compile(r"Couldn't instantiate class \w+ using the given arguments\.?")
"""draccus' words around the message of a `__post_init__`."""


def reason(error: BaseException) -> str:
    """Describe an error in one line with its first cause: draccus hides the message of a `__post_init__`."""
    first = error
    while first.__cause__ is not None:
        first = first.__cause__
    text = str(error) if first is error or str(first) in str(error) else f"{error} {first}"
    return " ".join(WRAPPER.sub("", text).split())


def load_plugins(args: Sequence[str]) -> list[str]:
    """Import the packages of `--<field>.discover_packages_path=<package>`; returns the other arguments.

    Raises:
        ValueError: if a package cannot be imported.
    """
    remaining = list(args)
    for flag, package in parser.parse_plugin_args(PLUGIN, args).items():
        try:
            parser.load_plugin(package)
        except parser.PluginLoadError as error:
            raise ValueError(f"--{flag}={package}: {reason(error)}") from error
        remaining = parser.filter_arg(flag, remaining)
    return remaining


def decode_environment(entries: Mapping[str, Any]) -> EnvConfig:
    """Decode an environment; `discover_packages_path` among its entries names a package that registers its type.

    Raises:
        ValueError: for an unknown type or field.
    """
    fields = dict(entries)
    if package := fields.pop(PLUGIN, None):
        load_plugins([f"--env.{PLUGIN}={package}"])
    try:
        return draccus.decode(EnvConfig, fields)
    except ParsingError as error:
        raise ValueError(f"env: {reason(error)}") from error


def parse_train_flags(args: Sequence[str]) -> TrainPipelineConfig:
    """Parse flags of lerobot-train with LeRobot's own configuration, defaults included.

    Raises:
        ValueError: for a flag or value that it refuses.
    """
    config_path = parser.parse_arg("config_path", args)
    args = parser.filter_arg("config_path", load_plugins(args))
    args = parser.filter_path_args(["policy", "reward_model"], args)
    printed, disabled = io.StringIO(), logging.root.manager.disable
    logging.disable(logging.WARNING)  # the run itself repeats LeRobot's warnings
    try:
        with redirect_stderr(printed):
            return draccus.parse(TrainPipelineConfig, config_path=config_path, args=args)
    except SystemExit as error:
        raise ValueError(printed.getvalue().rpartition("error: ")[2].strip()) from error
    except (ParsingError, OSError) as error:
        raise ValueError(reason(error)) from error
    finally:
        logging.disable(disabled)
