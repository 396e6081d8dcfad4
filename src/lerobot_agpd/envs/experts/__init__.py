"""Scripted experts, by environment type and task."""

from collections.abc import Mapping

from lerobot.envs.configs import EnvConfig

from lerobot_agpd.envs.experts import aloha, fetch, fetch_ways, lift_any, point_maze, robomimic
from lerobot_agpd.envs.experts.base import Expert
from lerobot_agpd.envs.experts.ways import WaysExpert

EXPERTS: Mapping[str, Mapping[str, Expert | WaysExpert]] = {
    "fetch_ways": fetch_ways.EXPERTS,
    "gymnasium_robotics": fetch.EXPERTS,
    "aloha_state": aloha.EXPERTS,
    "point_maze_ways": point_maze.EXPERTS,
    "robosuite_robomimic": robomimic.EXPERTS,
    "robosuite_ways": lift_any.EXPERTS,
}
"""Environment type (`--env.type`) and task (`--env.task`) to expert."""

IMPORT_COMMANDS = {
    "pusht": "lerobot-agpd-import-pusht",
    "robosuite_robomimic": "lerobot-agpd-import-robomimic",
}
"""Environment type to the command that imports people's demonstrations."""


def make_expert(env: EnvConfig) -> Expert | WaysExpert:
    """Find the expert of an environment's task.

    Args:
        env: an environment configuration of this package.

    Raises:
        ValueError: if the type or the task has no expert; it names the command that imports people's
            demonstrations, if there is one.
    """
    command = IMPORT_COMMANDS.get(env.type)
    instead = f" {command} imports people's demonstrations." if command else ""
    tasks = EXPERTS.get(env.type)
    if tasks is None:
        raise ValueError(
            f"--env.type={env.type} has no scripted experts. Types with some: {', '.join(EXPERTS)}.{instead}"
        )
    if env.task not in tasks:
        raise ValueError(
            f"--env.task={env.task} has no scripted expert. Tasks of {env.type} with one: "
            f"{', '.join(tasks)}.{instead}"
        )
    return tasks[str(env.task)]
