"""Which array of a robomimic file becomes which feature of a LeRobotDataset, as `--env.type=robosuite_robomimic` has it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from lerobot.utils.constants import ACTION, DONE, OBS_ENV_STATE, OBS_IMAGES, OBS_STATE, REWARD, SUCCESS

from lerobot_agpd.dataset_writer import Frame, flag, image, vector
from lerobot_agpd.envs.images import read_images
from lerobot_agpd.envs.robomimic_hdf5 import RobomimicFile
from lerobot_agpd.envs.robomimic_tasks import TASKS, RobomimicTask, key_dim

Array = np.ndarray

OPERATOR = "operator"
REWARDS, DONES = "rewards", "dones"
OBJECT = "obs/object"
CAMERA_SUFFIX = "_image"
REWARD_TOLERANCE = 1e-6


def task_of(file: RobomimicFile) -> RobomimicTask:
    """Task that a file was recorded in.

    Raises:
        ValueError: if this plugin does not have it.
    """
    name = file.env_args["env_name"]
    tasks = {task.robosuite_name: task for task in TASKS.values()}
    if name not in tasks:
        raise ValueError(f"{file.path}: env_name must be one of {', '.join(tasks)}; found {name!r}")
    return tasks[name]


def cameras_of(file: RobomimicFile, demo: str, requested: Sequence[str] | None) -> list[str]:
    """Cameras of a demonstration's image observations, all or those requested.

    Raises:
        ValueError: naming the flag, if there are none or a requested one is missing.
    """
    shapes = file.observation_shapes(demo)
    cameras = [key.removesuffix(CAMERA_SUFFIX) for key in shapes if key.endswith(CAMERA_SUFFIX)]
    if not cameras:
        raise ValueError(
            f"--images=true: {file.path} has no observations named <camera>{CAMERA_SUFFIX}; found {list(shapes)}"
        )
    missing = sorted(set(requested or ()) - set(cameras))
    if missing:
        raise ValueError(f"--cameras={missing}: {file.path} has the cameras {cameras}")
    return list(requested) if requested else cameras


@dataclass(frozen=True)
class RobomimicColumns:
    """The columns of an imported dataset.

    Attributes:
        file: source.
        demos: demonstrations to import; the first one tells the size of images.
        task: the file's task.
        cameras: cameras to import; none for low-dimensional data.
        has_environment_state: whether the objects' state is imported.
        has_rewards: whether reward and success are; machine-generated files may lack them.
        has_dones: whether the ends of episodes are.
        image_dtype: LeRobot's `image` (lossless PNG) or `video`.
    """

    file: RobomimicFile
    demos: list[str]
    task: RobomimicTask
    cameras: tuple[str, ...] = ()
    has_environment_state: bool = True
    has_rewards: bool = True
    has_dones: bool = True
    image_dtype: Literal["image", "video"] = "image"

    @property
    def features(self) -> dict[str, dict[str, Any]]:
        """LeRobot's features."""
        shapes = self.file.observation_shapes(self.demos[0])
        features: dict[str, dict[str, Any]] = {OBS_STATE: vector(self.task.agent_pos_dim)}
        if self.has_environment_state:
            features[OBS_ENV_STATE] = vector(self.task.environment_state_dim)
        for camera in self.cameras:
            shape = shapes[camera + CAMERA_SUFFIX]
            features[f"{OBS_IMAGES}.{camera}"] = image(shape, self.image_dtype)
        features[ACTION] = vector(self.task.action_dim)
        if self.has_rewards:
            features |= {REWARD: vector(1), SUCCESS: flag()}
        if self.has_dones:
            features[DONE] = flag()
        if self.file.operators:
            features[OPERATOR] = {"dtype": "int64", "shape": (1,), "names": None}
        return features

    def check(self) -> None:
        """Check the shapes of all arrays to be read; the values are checked while they are.

        Raises:
            ValueError: naming the demonstration and the array.
        """
        shapes: dict[str, tuple[int, ...]] = {"actions": (self.task.action_dim,)}
        shapes |= {key: () for key, used in ((REWARDS, self.has_rewards), (DONES, self.has_dones)) if used}
        shapes |= {f"obs/{key}": (key_dim(key),) for key in self.task.agent_keys}
        if self.has_environment_state:
            shapes[OBJECT] = (self.task.environment_state_dim,)
        first = self.file.observation_shapes(self.demos[0])
        names = [camera + CAMERA_SUFFIX for camera in self.cameras]
        self.file.check(self.demos, shapes | {f"obs/{name}": first[name] for name in names})

    def frames(self, demo: str) -> Iterator[Frame]:
        """Yield the frames of one demonstration."""
        columns = self.read(demo)
        for step in range(self.file.length(demo)):
            frame = {key: values[step] for key, values in columns.items()}
            yield {**frame, "task": self.task.description}

    def read(self, demo: str) -> dict[str, Array]:
        """Columns of one demonstration; float64 numbers become float32, images stay as they are.

        Reward, success and done belong to the state that an action leads to, as robomimic and LeRobot have it.

        Raises:
            ValueError: if an array is damaged or not finite, or an image is no image.
        """
        agent = [self.file.read(demo, f"obs/{key}") for key in self.task.agent_keys]
        columns = {
            OBS_STATE: np.concatenate(agent, axis=1).astype(np.float32),
            ACTION: self.file.read(demo, "actions").astype(np.float32),
        }
        if self.has_rewards:
            rewards = self.file.read(demo, REWARDS)[:, None]  # (T, 1)
            columns[REWARD] = rewards.astype(np.float32)
            columns[SUCCESS] = rewards >= self.file.full_reward - REWARD_TOLERANCE
        if self.has_dones:
            columns[DONE] = self.file.read(demo, DONES)[:, None] > 0
        if self.has_environment_state:
            columns[OBS_ENV_STATE] = self._environment_state(demo).astype(np.float32)
        for camera in self.cameras:
            key = f"obs/{camera}{CAMERA_SUFFIX}"
            images = read_images(self.file.read(demo, key), f"{self.file.path}: {demo}/{key}")
            columns[f"{OBS_IMAGES}.{camera}"] = images
        if self.file.operators:
            length = self.file.length(demo)
            columns[OPERATOR] = np.full((length, 1), self.file.operator_of(demo), dtype=np.int64)
        return columns

    def _environment_state(self, demo: str) -> Array:
        """Objects' state (T, E) in robosuite 1.5's order and signs, those of the environment type.

        Files of 1.4 and before list the same numbers in another order, and the vector from hand to cube points from
        the cube to the hand; both is undone here, exactly.
        """
        values = self.file.read(demo, OBJECT)
        if self.file.is_v15:
            return values
        ends = np.cumsum([key_dim(key) for key in self.task.object_keys_v141])[:-1]
        parts = dict(zip(self.task.object_keys_v141, np.split(values, ends, axis=1), strict=True))
        if "gripper_to_cube_pos" in parts:
            parts["gripper_to_cube_pos"] = parts["cube_pos"] - self.file.read(demo, "obs/robot0_eef_pos")
        return np.concatenate([parts[key] for key in self.task.object_keys], axis=1)
