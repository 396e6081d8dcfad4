"""What the environment types share: raw observation keys, options, features, and how environments are built."""

from abc import abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import gymnasium as gym
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_IMAGE, OBS_IMAGES, OBS_STATE

from lerobot_agpd.config import require
from lerobot_agpd.envs.poses import CameraPose

AGENT_POS = "agent_pos"
ENVIRONMENT_STATE = "environment_state"
PIXELS = "pixels"
"""Raw keys that LeRobot's `preprocess_observation` turns into its own."""

OBSERVED_KEYS: dict[str, tuple[str, ...]] = {
    "state": (AGENT_POS, ENVIRONMENT_STATE),
    "environment_state_agent_pos": (AGENT_POS, ENVIRONMENT_STATE),
    "pixels_agent_pos": (AGENT_POS, PIXELS),
    "pixels": (PIXELS,),
    "pixels_environment_state_agent_pos": (AGENT_POS, ENVIRONMENT_STATE, PIXELS),
}
"""Raw keys of every `--env.obs_type`; each environment type has some of them."""

DESCRIPTIONS = {
    "gym_pusht/PushT-v0": "Push the T-shaped block onto the T-shaped target.",
    "gym_aloha/AlohaInsertion-v0": "Insert the peg into the socket.",
    "gym_aloha/AlohaTransferCube-v0": "Pick up the cube with the right arm and hand it to the left arm.",
}
"""Task descriptions of gymnasium's environments that have none of their own."""


@dataclass(frozen=True, kw_only=True)
class TaskSpec:
    """Properties of one task.

    Attributes:
        description: one sentence, LeRobot's `task_description`.
        fps: control steps per second of simulated time, rounded down.
        episode_length: steps after which an episode is truncated by default.
        action_dim: length of an action.
        agent_pos_dim: length of `agent_pos`.
        environment_state_dim: length of `environment_state`.
    """

    description: str
    fps: int
    episode_length: int
    action_dim: int
    agent_pos_dim: int
    environment_state_dim: int


@dataclass(frozen=True)
class View:
    """What an environment shows; sizes of images are (height, width) in pixels.

    Attributes:
        keys: observed raw keys.
        cameras: cameras whose images are observed, each under its name; none: one image without a name.
        observation_size: of observed images.
        visualization_size: of rendered frames.
        shadows: whether images show them; without a GPU they take most of the time.
        antialiasing: whether edges are smooth; without a GPU images take a third of the time without.
        poses: of those cameras that are not the model's.
        main_pose: of rendered frames, and of an observed image without a name; None: the environment's own.
    """

    keys: tuple[str, ...] = (AGENT_POS, ENVIRONMENT_STATE)
    cameras: tuple[str, ...] = ()
    observation_size: tuple[int, int] = (96, 96)
    visualization_size: tuple[int, int] = (480, 480)
    shadows: bool = True
    antialiasing: bool = True
    poses: Mapping[str, CameraPose] = field(default_factory=dict)
    main_pose: CameraPose | None = None


def require_choice(option: str, value: str | list[str] | None, choices: Iterable[str]) -> None:
    """Raise FlagError unless the value of `--env.<option>` is one of the choices, or a list of at least one."""
    values = value if isinstance(value, list) else [value]
    require(
        bool(values) and set(values) <= set(choices),
        f"--env.{option}={value} must be {'at least one' if isinstance(value, list) else 'one'} of "
        f"{', '.join(choices)}",
    )


@dataclass
class SimulatedEnvConfig(EnvConfig):
    """Options of every environment type here.

    A type names its `tasks` and `obs_types` (and perhaps more choices), and builds an environment. Choices are no Literal
    types: argparse would hold the flags of every other environment type to them, since all have the same names.
    """

    tasks: ClassVar[Mapping[str, TaskSpec]]
    obs_types: ClassVar[tuple[str, ...]] = (
        "state",
        "pixels_agent_pos",
        "pixels",
        "pixels_environment_state_agent_pos",
    )

    # Control steps per second; default: the task's, the only possible value.
    fps: int | None = None
    # Steps after which an episode is truncated; default: the task's own limit.
    episode_length: int | None = None
    # What is observed: state, pixels_agent_pos, pixels, or all at once with pixels_environment_state_agent_pos.
    obs_type: str = "state"
    # Height of observed images, pixels.
    observation_height: int = 96
    # Width of observed images, pixels.
    observation_width: int = 96
    # Height of rendered frames, pixels.
    visualization_height: int = 480
    # Width of rendered frames, pixels.
    visualization_width: int = 480
    # Draw shadows; without a GPU an image is several times faster without.
    shadows: bool = True
    # Smooth edges; without a GPU an image takes a third of the time without.
    antialiasing: bool = True
    # gymnasium's render mode, rgb_array; nothing is rendered before `render` is called.
    render_mode: str = "rgb_array"
    # Derived from the task.
    features: dict[str, PolicyFeature] = field(default_factory=dict)
    # Raw key to LeRobot key, derived from the task.
    features_map: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check the options, fill in what the task decides and derive the features.

        Raises:
            FlagError: naming the option that is impossible.
        """
        for option, choices in self.choices.items():
            require_choice(option, getattr(self, option), choices)
        self.fps = self.spec.fps if self.fps is None else self.fps
        require(
            self.fps == self.spec.fps,
            f"--env.fps={self.fps}: {self.task} runs at {self.spec.fps} steps per second",
        )
        if self.episode_length is None:
            self.episode_length = self.spec.episode_length
        require(self.episode_length >= 1, f"--env.episode_length={self.episode_length} must be at least 1")
        require(
            min(self.observation_height, self.observation_width) >= 4,  # LeRobot takes 1 to 3 for channels
            f"--env.observation_height={self.observation_height} and --env.observation_width="
            f"{self.observation_width} must be at least 4 pixels",
        )
        self._set_features()

    def _set_features(self) -> None:
        view = self.view
        images = {f"{PIXELS}/{camera}": f"{OBS_IMAGES}.{camera}" for camera in view.cameras}
        images = (images or {PIXELS: OBS_IMAGE}) if PIXELS in view.keys else {}
        vectors = {
            AGENT_POS: PolicyFeature(FeatureType.STATE, (self.spec.agent_pos_dim,)),
            ENVIRONMENT_STATE: PolicyFeature(FeatureType.ENV, (self.spec.environment_state_dim,)),
        }
        image = PolicyFeature(FeatureType.VISUAL, (*view.observation_size, 3))
        self.features = {
            ACTION: PolicyFeature(FeatureType.ACTION, (self.spec.action_dim,)),
            **{key: feature for key, feature in vectors.items() if key in view.keys},
            **dict.fromkeys(images, image),
        }
        self.features_map = {
            ACTION: ACTION,
            AGENT_POS: OBS_STATE,
            ENVIRONMENT_STATE: OBS_ENV_STATE,
            **images,
        }

    @property
    def choices(self) -> dict[str, Iterable[str]]:
        """Possible values of the options that have a few."""
        return {"task": self.tasks, "obs_type": self.obs_types, "render_mode": ("rgb_array",)}

    @property
    def spec(self) -> TaskSpec:
        """Properties of the task."""
        return self.tasks[str(self.task)]

    @property
    def observed_cameras(self) -> tuple[str, ...]:
        """Cameras whose images are observed, each under its name; none: one image without a name."""
        return ()

    @property
    def view(self) -> View:
        """What the environments show."""
        return View(
            OBSERVED_KEYS[self.obs_type],
            self.observed_cameras,
            (self.observation_height, self.observation_width),
            (self.visualization_height, self.visualization_width),
            self.shadows,
            self.antialiasing,
        )

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Nothing: `make_single` builds the environments, not LeRobot by an id."""
        return {}

    @abstractmethod
    def make_single(self) -> gym.Env:
        """Build one environment; no graphics context is opened before the first image.

        Raises:
            ModuleNotFoundError: if the package of the simulation is not installed.
        """

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, VectorEnv]]:
        """Build a vector environment as LeRobot's own configurations do, autoreset in the same step.

        Those run `gymnasium.make` alone, which fails in forkserver workers, where nothing has imported the package that
        registers the id.

        Args:
            n_envs: number of environments.
            use_async_envs: one process per environment, if there are at least two.

        Returns:
            `{type: {0: vector environment}}`.

        Raises:
            ModuleNotFoundError: if the package of the simulation is not installed.
        """
        factories = [self.make_single] * n_envs  # picklable: workers import this package
        mode = AutoresetMode.SAME_STEP
        if use_async_envs and n_envs > 1:
            env: VectorEnv = AsyncVectorEnv(factories, context="forkserver", autoreset_mode=mode)
        else:
            env = SyncVectorEnv(factories, autoreset_mode=mode)
        return {self.type: {0: env}}
