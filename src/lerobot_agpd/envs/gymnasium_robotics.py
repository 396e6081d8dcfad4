"""LeRobot environment type `gymnasium_robotics`: the Fetch tasks with state observations.

The goal dictionary of Gymnasium-Robotics is split into LeRobot's two raw state keys:

- `agent_pos`: what the arm knows of itself (becomes `observation.state`);
- `environment_state`: the object, where there is one, and the desired goal (becomes
  `observation.environment_state`).

Another goal-conditioned task is added with one entry in `TASKS`.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE

AGENT_POS = "agent_pos"
ENVIRONMENT_STATE = "environment_state"


@dataclass(frozen=True)
class ObservationLayout:
    """Where the entries of a flat goal-environment observation go.

    Attributes:
        agent_pos: indices into the flat observation that make up `agent_pos`, in order.
        environment_state: indices that make up `environment_state`; the desired goal is appended to them.
        goal_dim: length of the desired goal.
    """

    agent_pos: tuple[int, ...]
    environment_state: tuple[int, ...]
    goal_dim: int

    @property
    def agent_pos_dim(self) -> int:
        """Length of `agent_pos`."""
        return len(self.agent_pos)

    @property
    def environment_state_dim(self) -> int:
        """Length of `environment_state`, the desired goal included."""
        return len(self.environment_state) + self.goal_dim

    def split(self, observation: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Turn one goal observation into LeRobot's raw keys.

        Args:
            observation: `observation` (D,) and `desired_goal` (goal_dim,), metres, radians and
                metres or radians per control step.

        Returns:
            `agent_pos` (agent_pos_dim,) and `environment_state` (environment_state_dim,), both float32.
        """
        flat = observation["observation"]
        scene = flat[list(self.environment_state)]
        return {
            AGENT_POS: flat[list(self.agent_pos)].astype(np.float32),
            ENVIRONMENT_STATE: np.concatenate([scene, observation["desired_goal"]]).astype(np.float32),
        }


@dataclass(frozen=True)
class TaskSpec:
    """What this plugin must know of one Gymnasium-Robotics task.

    Attributes:
        description: one sentence, LeRobot's `task_description`.
        layout: how its observation is split.
        action_dim: length of an action; actions lie in [-1, 1].
        fps: control steps per second of simulated time.
    """

    description: str
    layout: ObservationLayout
    action_dim: int
    fps: int


# Grip position (3), finger displacements (2), grip velocity (3), finger velocities (2): an arm alone has these only.
_FETCH_ARM = ObservationLayout(agent_pos=tuple(range(10)), environment_state=(), goal_dim=3)
# With an object, its position (3:6), position from the grip (6:9), rotation (11:14), velocity from the grip (14:17)
# and angular velocity (17:20) lie between them.
_FETCH_OBJECT = ObservationLayout(
    agent_pos=(0, 1, 2, 9, 10, 20, 21, 22, 23, 24),
    environment_state=(*range(3, 9), *range(11, 20)),
    goal_dim=3,
)

TASKS: dict[str, TaskSpec] = {
    "FetchReach-v4": TaskSpec("Move the gripper to the target position.", _FETCH_ARM, 4, 25),
    "FetchPush-v4": TaskSpec("Push the block to the target position on the table.", _FETCH_OBJECT, 4, 25),
    "FetchPickAndPlace-v4": TaskSpec(
        "Pick up the block and bring it to the target position.", _FETCH_OBJECT, 4, 25
    ),
    "FetchSlide-v4": TaskSpec("Hit the puck so that it slides to the target position.", _FETCH_OBJECT, 4, 25),
}


def get_task_spec(task: str | None) -> TaskSpec:
    """Look a task up in `TASKS`.

    Raises:
        ValueError: if the task is not known.
    """
    if task not in TASKS:
        raise ValueError(f"Unknown gymnasium_robotics task {task!r}. Known tasks: {', '.join(TASKS)}.")
    return TASKS[task]


class GoalToStateWrapper(gym.ObservationWrapper, RecordConstructorArgs):
    """Present a goal-conditioned environment the way LeRobot expects it.

    Observations become `agent_pos` and `environment_state` (float32); `info["is_success"]` is a bool after every
    step and after a reset; `task` and `task_description` are attributes.
    """

    def __init__(self, env: gym.Env, task: str) -> None:
        """Wrap `env`, one of the environments listed in `TASKS`.

        Args:
            env: environment with the goal observation dictionary.
            task: its key in `TASKS`.

        Raises:
            ValueError: if the task is not known.
        """
        RecordConstructorArgs.__init__(self, task=task)
        super().__init__(env)
        spec = get_task_spec(task)
        self.task = task
        self.task_description = spec.description
        self._layout = spec.layout
        # Kept for the success at reset, which the environment itself reports from the first step on only.
        self._goal_observation: dict[str, np.ndarray] = {}
        self.observation_space = gym.spaces.Dict(
            {
                AGENT_POS: _unbounded(self._layout.agent_pos_dim),
                ENVIRONMENT_STATE: _unbounded(self._layout.environment_state_dim),
            }
        )

    def observation(self, observation: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Split one goal observation; see `ObservationLayout.split`."""
        self._goal_observation = observation
        return self._layout.split(observation)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Reset, and tell in `info["is_success"]` whether the goal holds already."""
        observation, info = super().reset(seed=seed, options=options)
        goal = self._goal_observation
        goal_env: Any = self.env.unwrapped
        success = goal_env._is_success(goal["achieved_goal"], goal["desired_goal"])
        return observation, {**info, "is_success": bool(success)}

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Step, with a float reward and a bool `info["is_success"]`."""
        observation, reward, terminated, truncated, info = super().step(action)
        info = {**info, "is_success": bool(info["is_success"])}
        return observation, float(reward), terminated, truncated, info


def _unbounded(dim: int) -> gym.spaces.Box:
    return gym.spaces.Box(-np.inf, np.inf, shape=(dim,), dtype=np.float32)


def _require_gymnasium_robotics() -> None:
    """Import Gymnasium-Robotics, which registers its environments with gymnasium.

    Raises:
        ModuleNotFoundError: if it or something that it needs is not installed.
    """
    try:
        import gymnasium_robotics  # noqa: F401
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            f"The gymnasium_robotics environments need the package {error.name!r}, which is not installed. "
            "Run: pip install 'lerobot_policy_agpd[fetch]'",
            name=error.name,
        ) from error


def make_single_env(task: str, gym_kwargs: dict[str, Any]) -> gym.Env:
    """Build one wrapped environment.

    A worker process that has imported nothing yet can call it. No graphics context is opened before the first
    `render()`.

    Args:
        task: key of `TASKS`.
        gym_kwargs: passed on to `gymnasium.make`.

    Raises:
        ModuleNotFoundError: if Gymnasium-Robotics is not installed.
        ValueError: if the task is not known.
    """
    _require_gymnasium_robotics()
    return GoalToStateWrapper(gym.make(task, **gym_kwargs), task)


@EnvConfig.register_subclass("gymnasium_robotics")
@dataclass
class GymnasiumRoboticsEnv(EnvConfig):
    """Fetch tasks of Gymnasium-Robotics, seen through their state.

    Attributes:
        task: one of `TASKS`.
        fps: control steps per second; 25, the simulation allows no other.
        episode_length: steps after which an episode is truncated.
        obs_type: `state`, the only kind so far.
        render_mode: gymnasium's render mode; nothing is rendered unless asked for.
        visualization_width: width of rendered frames, pixels.
        visualization_height: height of rendered frames, pixels.
        features: shapes of the raw keys, derived from the task.
        features_map: raw key to LeRobot key.
    """

    task: str | None = "FetchPickAndPlace-v4"
    fps: int = 25
    episode_length: int = 50
    obs_type: str = "state"
    render_mode: str = "rgb_array"
    visualization_width: int = 480
    visualization_height: int = 480
    features: dict[str, PolicyFeature] = field(default_factory=dict)
    features_map: dict[str, str] = field(
        default_factory=lambda: {ACTION: ACTION, AGENT_POS: OBS_STATE, ENVIRONMENT_STATE: OBS_ENV_STATE}
    )

    def __post_init__(self) -> None:
        """Derive the features.

        Raises:
            ValueError: if the task or the observation type is not known, the frame rate is not the simulation's or
                the episode length is not positive.
        """
        spec = get_task_spec(self.task)
        if self.obs_type != "state":
            raise ValueError(f"gymnasium_robotics knows obs_type 'state' only, got {self.obs_type!r}.")
        if self.fps != spec.fps:
            raise ValueError(f"{self.task} runs at {spec.fps} steps per second, got fps={self.fps}.")
        if self.episode_length < 1:
            raise ValueError(f"episode_length must be at least 1, got {self.episode_length}.")
        self.features = {
            ACTION: PolicyFeature(type=FeatureType.ACTION, shape=(spec.action_dim,)),
            AGENT_POS: PolicyFeature(type=FeatureType.STATE, shape=(spec.layout.agent_pos_dim,)),
            ENVIRONMENT_STATE: PolicyFeature(
                type=FeatureType.ENV, shape=(spec.layout.environment_state_dim,)
            ),
        }

    @property
    def package_name(self) -> str:
        """Package that registers the environments."""
        return "gymnasium_robotics"

    @property
    def gym_id(self) -> str:
        """Id for `gymnasium.make`: the task itself, without a namespace."""
        return str(self.task)

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Keyword arguments for `gymnasium.make`."""
        return {
            "render_mode": self.render_mode,
            "width": self.visualization_width,
            "height": self.visualization_height,
            "max_episode_steps": self.episode_length,
            "disable_env_checker": self.disable_env_checker,
        }

    def make_single(self) -> gym.Env:
        """Build one environment outside any vector environment; see `make_single_env`."""
        return make_single_env(self.gym_id, self.gym_kwargs)

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, VectorEnv]]:
        """Build the vector environment, as LeRobot's own method does, with a factory that imports its package.

        LeRobot's factory runs `gymnasium.make` alone and fails in forkserver workers, where nothing has imported
        Gymnasium-Robotics.

        Args:
            n_envs: number of environments.
            use_async_envs: one process per environment, if there are at least two.

        Returns:
            `{"gymnasium_robotics": {0: vector environment}}`, autoreset in the same step.

        Raises:
            ModuleNotFoundError: if Gymnasium-Robotics is not installed.
        """
        _require_gymnasium_robotics()
        factory: Callable[[], gym.Env] = partial(make_single_env, self.gym_id, self.gym_kwargs)
        factories = [factory] * n_envs
        vector_env: VectorEnv
        if use_async_envs and n_envs > 1:
            vector_env = AsyncVectorEnv(
                factories, context="forkserver", autoreset_mode=AutoresetMode.SAME_STEP
            )
        else:
            vector_env = SyncVectorEnv(factories, autoreset_mode=AutoresetMode.SAME_STEP)
        return {self.type: {0: vector_env}}
