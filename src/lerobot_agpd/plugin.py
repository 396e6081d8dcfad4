"""Register everything this plugin adds to LeRobot: policy types and environment types.

Every type is registered on its own. Another plugin may hold one of the names already, and LeRobot drops a plugin whose
import fails: without the guard a clash of one name would cost all types.
"""

import importlib
import logging
import multiprocessing
import os
import sys
from collections.abc import Mapping

from lerobot.configs import PreTrainedConfig
from lerobot.envs.configs import EnvConfig

from lerobot_agpd.advice import advice

logger = logging.getLogger(__name__)

ENV_TYPES = {
    "aloha_state": "lerobot_agpd.envs.aloha",
    "fetch_ways": "lerobot_agpd.envs.fetch_ways",
    "gymnasium_robotics": "lerobot_agpd.envs.gymnasium_robotics",
    "point_maze_ways": "lerobot_agpd.envs.point_maze",
    "pusht_state": "lerobot_agpd.envs.pusht",
    "robosuite_robomimic": "lerobot_agpd.envs.robomimic",
    "robosuite_ways": "lerobot_agpd.envs.robosuite_ways",
}
"""`--env.type` to the module that registers it."""

POLICY_TYPES = {
    name: f"lerobot_agpd.policies.{name}.configuration_{name}"
    for name in ("diffusion_transformer", "act_diffusion", "agpd", "agpd_diffusion")
}
"""`--policy.type` to the module that registers it."""

FORKSERVER_PRELOAD = [
    "lerobot_agpd.envs.orphans",
    "lerobot_agpd.envs.workers",
    "lerobot_agpd.plugin",
    "gymnasium_robotics",
]
"""Modules that the forkserver of LeRobot's environment workers imports once, instead of every worker: most of a
worker's start is LeRobot's imports. What is not installed is skipped."""


def register(
    flag: str, registry: type[EnvConfig] | type[PreTrainedConfig], modules: Mapping[str, str]
) -> None:
    """Import the modules that register types, each on its own.

    A module that cannot be imported is left out, with a warning that says why.

    Args:
        flag: command-line flag that selects the type.
        registry: class that knows the registered types.
        modules: type to module.
    """
    for name, module in modules.items():
        holder = registry.get_known_choices().get(name)
        if holder is not None and holder.__module__ != module:
            logger.warning(
                "%s=%s of lerobot_policy_agpd is not available: %s of %s has the name already",
                flag,
                name,
                holder.__qualname__,
                holder.__module__,
            )
            continue
        try:
            importlib.import_module(module)
        except Exception:  # one broken module must not cost the other types
            logger.warning("%s=%s of lerobot_policy_agpd is not available", flag, name, exc_info=True)


def warn_of_refused_command() -> None:
    """Say what a `lerobot-train` command that LeRobot is about to refuse should have been."""
    is_main_process = multiprocessing.parent_process() is None and os.environ.get("RANK", "0") == "0"
    for text in advice(sys.argv) if is_main_process else ():
        logger.warning(text)


register("--env.type", EnvConfig, ENV_TYPES)
register("--policy.type", PreTrainedConfig, POLICY_TYPES)
warn_of_refused_command()
multiprocessing.set_forkserver_preload(FORKSERVER_PRELOAD)
