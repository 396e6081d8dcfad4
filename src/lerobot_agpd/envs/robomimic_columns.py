"""Which array of a robomimic file becomes which feature of a LeRobotDataset, as `--env.type=robomimic` observes it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from lerobot.utils.constants import ACTION, DONE, OBS_ENV_STATE, OBS_IMAGES, OBS_STATE, REWARD, SUCCESS

from lerobot_agpd.envs.robomimic_hdf5 import RobomimicFile
from lerobot_agpd.envs.robomimic_tasks import TASKS, RobomimicTask, key_dim

Array = np.ndarray

OPERATOR = "operator"
OBJECT = "obs/object"
CAMERA_SUFFIX = "_image"
REWARD_TOLERANCE = 1e-6


def task_of(file: RobomimicFile) -> RobomimicTask:
    """The task that a file was recorded in.

    Raises:
        ValueError: if this plugin does not have it.
    """
    name = file.env_args["env_name"]
    for task in TASKS.values():
        if task.robosuite_name == name:
            return task
    known = ", ".join(task.robosuite_name for task in TASKS.values())
    raise ValueError(f"{file.path}: env_name must be one of {known}; found {name!r}")


def cameras_of(file: RobomimicFile, demo: str, wanted: Sequence[str] | None) -> list[str]:
    """Cameras of a demonstration's image observations, all or those wanted.

    Raises:
        ValueError: naming the flag, if there are none or a wanted one is missing.
    """
    found = [
        key.removesuffix(CAMERA_SUFFIX)
        for key in file.observation_shapes(demo)
        if key.endswith(CAMERA_SUFFIX)
    ]
    if not found:
        raise ValueError(
            f"--images=true: {file.path} has no observations named <camera>{CAMERA_SUFFIX}; found "
            f"{sorted(file.observation_shapes(demo))}"
        )
    missing = sorted(set(wanted or ()) - set(found))
    if missing:
        raise ValueError(f"--cameras={missing}: {file.path} has the cameras {found}")
    return list(wanted) if wanted else found


@dataclass(frozen=True)
class RobomimicColumns:
    """The columns of an imported dataset.

    Attributes:
        file: where they come from.
        task: the file's task.
        cameras: those to import; none for low-dimensional data.
        has_environment_state: whether the objects' state is imported.
        image_dtype: LeRobot's `image` (lossless PNG) or `video`.
    """

    file: RobomimicFile
    task: RobomimicTask
    cameras: tuple[str, ...]
    has_environment_state: bool
    image_dtype: str = "image"

    def features(self, demo: str) -> dict[str, dict[str, Any]]:
        """LeRobot's features; `demo` tells the images' size."""
        vector: dict[str, Any] = {"dtype": "float32", "names": None}
        flag = {"dtype": "bool", "shape": (1,), "names": None}
        features: dict[str, dict[str, Any]] = {OBS_STATE: {**vector, "shape": (self.task.agent_pos_dim,)}}
        if self.has_environment_state:
            features[OBS_ENV_STATE] = {**vector, "shape": (self.task.environment_state_dim,)}
        observed = self.file.observation_shapes(demo)
        for camera in self.cameras:
            features[f"{OBS_IMAGES}.{camera}"] = {
                "dtype": self.image_dtype,
                "shape": observed[camera + CAMERA_SUFFIX],
                "names": ["height", "width", "channel"],
            }
        features[ACTION] = {**vector, "shape": (self.task.action_dim,)}
        features[REWARD] = {**vector, "shape": (1,)}
        features[SUCCESS], features[DONE] = dict(flag), dict(flag)
        if self.file.operators:
            features[OPERATOR] = {"dtype": "int64", "shape": (1,), "names": None}
        return features

    def shapes(self, demo: str) -> dict[str, tuple[int, ...]]:
        """Shape of one step of every array to be read; images have the size that they have in `demo`."""
        shapes: dict[str, tuple[int, ...]] = {"actions": (self.task.action_dim,), "rewards": (), "dones": ()}
        shapes |= {f"obs/{key}": (key_dim(key),) for key in self.task.agent_keys}
        if self.has_environment_state:
            shapes[OBJECT] = (self.task.environment_state_dim,)
        observed = self.file.observation_shapes(demo)
        return shapes | {
            f"obs/{name}{CAMERA_SUFFIX}": observed[name + CAMERA_SUFFIX] for name in self.cameras
        }

    def read(self, demo: str) -> dict[str, Array]:
        """Columns of one demonstration; float64 numbers become float32, images stay as they are.

        Reward, success and done belong to the state that an action leads to, as robomimic and LeRobot have it.

        Raises:
            ValueError: if an array is damaged or not finite, or an image is not uint8.
        """
        rewards = self.file.read(demo, "rewards")[:, None]  # (T, 1)
        agent = [self.file.read(demo, f"obs/{key}") for key in self.task.agent_keys]
        columns = {
            OBS_STATE: np.concatenate(agent, axis=1).astype(np.float32),
            ACTION: self.file.read(demo, "actions").astype(np.float32),
            REWARD: rewards.astype(np.float32),
            SUCCESS: rewards >= self.file.full_reward - REWARD_TOLERANCE,
            DONE: self.file.read(demo, "dones")[:, None] > 0,
        }
        if self.has_environment_state:
            columns[OBS_ENV_STATE] = self._environment_state(demo).astype(np.float32)
        for camera in self.cameras:
            columns[f"{OBS_IMAGES}.{camera}"] = self._images(demo, camera)
        if self.file.operators:
            columns[OPERATOR] = np.full((len(rewards), 1), self.file.operator_of(demo), dtype=np.int64)
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

    def _images(self, demo: str, camera: str) -> Array:
        key = f"obs/{camera}{CAMERA_SUFFIX}"
        images = self.file.read(demo, key)
        if images.dtype != np.uint8 or images.ndim != 4 or images.shape[-1] != 3:
            raise ValueError(
                f"{self.file.path}: {demo}/{key} must be uint8 (T, H, W, 3), found {images.dtype} {images.shape}"
            )
        return images
