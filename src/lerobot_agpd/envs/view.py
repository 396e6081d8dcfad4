"""What is known of a task, and what an environment shows of it."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from lerobot_agpd.envs.poses import CameraPose
from lerobot_agpd.textures import mask_of

AGENT_POS = "agent_pos"
ENVIRONMENT_STATE = "environment_state"
PIXELS = "pixels"
"""Raw keys that LeRobot's `preprocess_observation` turns into its own."""


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
        antialiasing: whether edges are smooth; without a GPU an image is faster without.
        poses: of those cameras that are not the model's.
        masks: whether the background's mask is observed with every camera.
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
    masks: bool = False

    @property
    def image_names(self) -> list[str]:
        """Observed images that have a name: those of the cameras, and their masks."""
        return [*self.cameras, *(mask_of(camera) for camera in self.cameras if self.masks)]
