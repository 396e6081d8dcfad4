"""The point mass of point_environment with a camera, and a teacher that sees another thing than its student."""

from dataclasses import dataclass, field

import gymnasium as gym
import numpy as np
import point_environment
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.envs import EnvConfig
from point_environment import FEATURE_NAMES, FPS, LIMIT, Point, PointEnv, PointTeacher
from small_dataset import FEATURES

NAME = "lerobot_agpd_tests/PointCamera-v0"
STATE, ENV, IMAGE = "observation.state", "observation.environment_state", "observation.image"
MASK = f"{IMAGE}_mask"
NAMES = {**FEATURE_NAMES, "pixels": IMAGE}
SIZE = 24


class PointCamera(Point):
    """Shows the point as a white dot in an image whose edges are 3 long."""

    def __init__(self, size: int = SIZE):
        self.size = size
        spaces = dict(Point.observation_space)
        self.observation_space = gym.spaces.Dict(
            **spaces, pixels=gym.spaces.Box(0, 255, (size, size, 3), np.uint8)
        )

    def observation(self):
        pixels = np.full((self.size, self.size, 3), 40, dtype=np.uint8)
        row, column = ((self.position / 3 + 0.5) * (self.size - 2)).clip(0, self.size - 2).astype(int)
        pixels[row : row + 2, column : column + 2] = 255
        return {**super().observation(), "pixels": pixels}


class MaskedPointCamera(PointCamera):
    """With a mask beside the image: the lower half is the background."""

    def observation(self):
        observation = super().observation()
        mask = np.zeros_like(observation["pixels"])
        mask[self.size // 2 :] = 255
        return {**observation, "mask": mask}


if NAME not in gym.registry:
    gym.register(NAME, entry_point=PointCamera, max_episode_steps=LIMIT)


@EnvConfig.register_subclass("agpd_test_point_camera")
@dataclass
class PointCameraEnv(PointEnv):
    """`--env.type=agpd_test_point_camera`; `shown` raw keys."""

    task: str | None = "PointCamera-v0"
    size: int = SIZE
    shown: tuple[str, ...] = ("agent_pos", "environment_state", "pixels")
    features_map: dict[str, str] = field(default_factory=lambda: {"action": "action", **NAMES})

    def __post_init__(self):
        pixels = PolicyFeature(FeatureType.VISUAL, (SIZE, SIZE, 3))  # whatever it delivers
        features = {**self.features, "pixels": pixels}
        self.features = {key: features[key] for key in (*self.shown, "action")}

    @property
    def gym_kwargs(self):
        return {"size": self.size}


class StateTeacher(PointTeacher):
    """Goes toward the origin, whose direction and distance it sees in the environment state alone."""

    def __init__(self, spread=0.01):
        super().__init__(spread)
        self.policy.config.input_features = {ENV: PolicyFeature(FeatureType.ENV, (3,))}

    def sample(self, history, guide=None, generator=None):
        assert set(history) - {"task"} >= {ENV}
        seen = history[ENV]
        return super().sample(
            {STATE: seen[..., :2] * seen[..., 2:], "task": history["task"]}, guide, generator
        )


def demonstrate(root, left_out: tuple[str, ...] = (MASK,)) -> LeRobotDataset:
    """Record three episodes of the teacher's law, without some of the features."""
    image = {"dtype": "image", "shape": (SIZE, SIZE, 3), "names": ["height", "width", "channels"]}
    features = {**FEATURES, IMAGE: image, MASK: image}
    features = {key: value for key, value in features.items() if key not in left_out}
    dataset = LeRobotDataset.create("local/point_camera", FPS, features, root=root, use_videos=False)
    return point_environment.demonstrate(dataset, 3, MaskedPointCamera(), {**NAMES, "mask": MASK})
