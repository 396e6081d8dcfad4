"""What the environment types share: raw observation keys, options, features, and how environments are built."""

from abc import abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import gymnasium as gym
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_IMAGE, OBS_IMAGES, OBS_STATE

from lerobot_agpd.envs.view import AGENT_POS, ENVIRONMENT_STATE, PIXELS, TaskSpec, View
from lerobot_agpd.flag_checks import require
from lerobot_agpd.textures import Textures

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
    # Draw smooth edges; without a GPU an image is faster without.
    antialiasing: bool = True
    # Show masks too, one image per camera, <camera>_mask: white where nothing can move.
    masks: bool = False
    # Another background in every episode, where nothing can move: noise, stripes or a folder of pictures; default: the
    # simulation's own.
    background: str | None = None
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
        self._check_masks()
        self._set_features()

    def _check_masks(self) -> None:
        shows_cameras = bool(self.observed_cameras) and PIXELS in OBSERVED_KEYS[self.obs_type]
        for option in ("masks", "background"):
            value = getattr(self, option)
            require(
                not value or shows_cameras,
                f"--env.{option}={value}: there are masks for named cameras alone, if --env.type={self.type} has any; choose "
                "some with --env.cameras and show them (--env.obs_type)",
            )
        if self.background is not None:
            Textures(self.background, "--env.background")

    def _set_features(self) -> None:
        view = self.view
        names = replace(view, masks=self.masks).image_names
        images = {f"{PIXELS}/{name}": f"{OBS_IMAGES}.{name}" for name in names}
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
            masks=self.masks or self.background is not None,
        )

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Nothing: `build` builds the environments, not LeRobot by an id."""
        return {}

    @abstractmethod
    def make_single(self) -> gym.Env:
        """Build one environment; no graphics context is opened before the first image.

        Raises:
            ModuleNotFoundError: if the package of the simulation is not installed.
        """

    def build(self) -> gym.Env:
        """Build one environment as it is shown: that of `make_single`, before another background if there is one."""
        env = self.make_single()
        if self.background is None:
            return env
        from lerobot_agpd.envs.backgrounds import Backgrounds

        return Backgrounds(env, Textures(self.background, "--env.background"), keep_masks=self.masks)

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
        factories = [self.build] * n_envs  # picklable: workers import this package
        mode = AutoresetMode.SAME_STEP
        if use_async_envs and n_envs > 1:
            env: VectorEnv = AsyncVectorEnv(factories, context="forkserver", autoreset_mode=mode)
        else:
            env = SyncVectorEnv(factories, autoreset_mode=mode)
        return {self.type: {0: env}}
