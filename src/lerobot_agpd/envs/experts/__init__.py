"""Scripted experts, by environment type and task."""

from collections.abc import Mapping

from lerobot.envs.configs import EnvConfig

from lerobot_agpd.envs.experts import fetch
from lerobot_agpd.envs.experts.base import Expert

EXPERTS: Mapping[str, Mapping[str, Expert]] = {"gymnasium_robotics": fetch.EXPERTS}
"""Environment type (`--env.type`) and task (`--env.task`) to expert."""


def make_expert(env: EnvConfig) -> Expert:
    """Find the expert of an environment's task.

    Args:
        env: an environment configuration of this package.

    Returns:
        A pure function from the raw observation of a single environment (`agent_pos`, `environment_state`) to an
        action.

    Raises:
        ValueError: if the type or the task has no expert.
    """
    tasks = EXPERTS.get(env.type)
    if tasks is None:
        raise ValueError(
            f"--env.type={env.type} has no scripted experts. Types with some: {', '.join(EXPERTS)}."
        )
    if env.task not in tasks:
        raise ValueError(
            f"--env.task={env.task} has no scripted expert. Tasks of {env.type} with one: {', '.join(tasks)}."
        )
    return tasks[env.task]
