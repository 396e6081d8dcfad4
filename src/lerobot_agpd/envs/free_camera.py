"""Options of environment types whose cameras can be moved."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from lerobot_agpd.envs.base import SimulatedEnvConfig, View, require_choice
from lerobot_agpd.envs.poses import CameraPose
from lerobot_agpd.flag_checks import require


@dataclass
class FreeCameraEnvConfig(SimulatedEnvConfig):
    """Adds the pose of the main camera, and named cameras in the place of its image."""

    # Cameras to observe in the place of the main one, e.g. '["front","side"]' (Fetch only).
    cameras: list[str] | None = None
    # Distance of the main camera from what it looks at, meters; default: the task's.
    camera_distance: float | None = None
    # Point that the main camera looks at, meters, e.g. "[1.3,0.75,0.58]"; default: the task's.
    camera_lookat: list[float] | None = None
    # Direction of the main camera around the vertical, degrees; default: the task's.
    camera_azimuth: float | None = None
    # Angle of the main camera against the horizontal, degrees, negative looks down; default: the task's.
    camera_elevation: float | None = None

    def __post_init__(self) -> None:
        """Check the options, fill in what depends on the task and derive the features.

        Raises:
            FlagError: if an option is unknown or does not fit the task.
        """
        super().__post_init__()
        poses = self.task_poses
        require(
            self.cameras is None or bool(poses),
            f"--env.cameras={self.cameras}: {self.task} has no named cameras; leave the option out",
        )
        if self.cameras is not None:
            require_choice("cameras", self.cameras, poses)
        require(
            not self._moved or self.main_pose is not None,
            f"--env.camera_*: the camera of {self.task} is fixed; leave {sorted(self._moved)} out",
        )
        require(
            self.camera_distance is None or self.camera_distance > 0,
            f"--env.camera_distance must be positive, got {self.camera_distance}",
        )
        require(
            self.camera_lookat is None or len(self.camera_lookat) == 3,
            f"--env.camera_lookat={self.camera_lookat} must be three numbers, meters",
        )

    @property
    def task_pose(self) -> CameraPose | None:
        """Pose of the task's main camera; None: the environment's own camera, which cannot be moved."""
        return None

    @property
    def task_poses(self) -> Mapping[str, CameraPose]:
        """Poses of the task's named cameras."""
        return {}

    @property
    def observed_cameras(self) -> tuple[str, ...]:
        """Cameras whose images are observed, each under its name; none: one image without a name."""
        return tuple(self.cameras or ())

    @property
    def _moved(self) -> dict[str, Any]:
        """The given parts of the main camera's pose."""
        names = ("distance", "lookat", "azimuth", "elevation")
        given = {name: getattr(self, f"camera_{name}") for name in names}
        return {
            name: tuple(value) if name == "lookat" else value
            for name, value in given.items()
            if value is not None
        }

    @property
    def main_pose(self) -> CameraPose | None:
        """Pose of the main camera."""
        return None if self.task_pose is None else replace(self.task_pose, **self._moved)

    @property
    def view(self) -> View:
        """What the environments show."""
        poses = {name: pose for name, pose in self.task_poses.items() if name in self.observed_cameras}
        return replace(super().view, poses=poses, main_pose=self.main_pose)
