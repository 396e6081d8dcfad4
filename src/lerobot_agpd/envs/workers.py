"""What LeRobot's environment workers must know before they start; imported by their forkserver.

LeRobot starts the workers of asynchronous vector environments from a forkserver. Two things go wrong there for
environments that LeRobot creates by their gymnasium id: the worker never imports the package that registers the
id, and LeRobot asks it for `task_description`, which gymnasium answers for an environment without one by shutting
the worker down. Both are cured in gymnasium's own registry.
"""

import importlib

import gymnasium as gym
from gymnasium.envs.registration import WrapperSpec

from lerobot_agpd.envs.base import DESCRIPTIONS


class TaskDescription(gym.Wrapper):
    """Adds the attributes `task` and `task_description`, which LeRobot asks every environment for."""

    def __init__(self, env: gym.Env, description: str):
        super().__init__(env)
        self.task = description
        self.task_description = description


def register_task_descriptions() -> None:
    """Have gymnasium wrap the environments of DESCRIPTIONS whose packages are installed."""
    for env_id, description in DESCRIPTIONS.items():
        try:
            importlib.import_module(env_id.split("/")[0])
        except ModuleNotFoundError:
            continue
        entry_point = f"{__name__}:{TaskDescription.__name__}"
        wrapper = WrapperSpec(TaskDescription.__name__, entry_point, {"description": description})
        gym.spec(env_id).additional_wrappers += (wrapper,)


register_task_descriptions()
