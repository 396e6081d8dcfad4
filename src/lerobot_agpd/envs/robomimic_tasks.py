"""The tasks of robomimic (arXiv:2108.03298) that `--env.type=robosuite_robomimic` has, as a table without a simulator.

`agent_pos` is the concatenation of `RobomimicTask.agent_keys` (HDF5: `obs/<key>`), `environment_state` that of
`RobomimicTask.object_keys` (HDF5: one array, `obs/object`).

Horizons and cameras are robomimic's (v0.5.0: `robomimic/__init__.py` and
`robomimic/scripts/extract_obs_from_raw_datasets.sh`), object keys robosuite's own observables.
"""

from dataclasses import dataclass
from typing import Any

from lerobot_agpd.envs.base import AGENT_POS, ENVIRONMENT_STATE, PIXELS

FPS = 20
"""Control steps per second of simulated time (`control_freq`)."""

ROBOT = "Panda"

ARM_CONTROLLER: dict[str, Any] = {
    "type": "OSC_POSE",
    "input_max": 1,
    "input_min": -1,
    "output_max": [0.05, 0.05, 0.05, 0.5, 0.5, 0.5],  # meters, radians
    "output_min": [-0.05, -0.05, -0.05, -0.5, -0.5, -0.5],
    "kp": 150,
    "damping_ratio": 1,
    "impedance_mode": "fixed",
    "kp_limits": [0, 300],
    "damping_ratio_limits": [0, 10],
    "position_limits": None,
    "orientation_limits": None,
    "uncouple_pos_ori": True,
    "input_type": "delta",
    "input_ref_frame": "world",
    "interpolation": None,
    "ramp_ratio": 0.2,
    "gripper": {"type": "GRIP"},
}
"""robosuite 1.5's controller of every arm: that of robomimic's datasets (`env_args` of their files: composite `BASIC`).

Values are those of robomimic's `docs/modules/environments.md` (v0.5.0), where `damping` and `control_delta` are
1.4.1's names for `damping_ratio` and `input_type`.
"""

ARM_ACTION_DIM = 7
"""Per arm: displacement x, y, z (1 is 5 cm), rotation vector x, y, z (1 is 0.5 rad), gripper (-1 open, 1 closed)."""

ARM_KEYS = ("eef_pos", "eef_quat", "gripper_qpos")
"""Observables of an arm for robomimic's low-dimensional policies, in its order, without the prefix `robot0_` or `robot1_`."""

OBSERVED_KEYS: dict[str, tuple[str, ...]] = {
    "state": (AGENT_POS, ENVIRONMENT_STATE),
    "pixels_agent_pos": (AGENT_POS, PIXELS),
    "pixels": (PIXELS,),
}
"""Raw keys of every `--env.obs_type`."""


def key_dim(key: str) -> int:
    """Length of one observable of robosuite, by its name.

    Positions have 3 numbers (meters), quaternions 4 (x, y, z, w), the two fingers 2 (meters, of opposite sign), flags
    1; vectors from a gripper to an object, such as `gripper0_to_payload`, 3.
    """
    if key.endswith("_quat"):
        return 4
    if key.endswith("_gripper_qpos"):
        return 2
    if key.endswith("_pos") or key.startswith("gripper"):
        return 3
    return 1


@dataclass(frozen=True)
class RobomimicTask:
    """Properties of one task.

    Attributes:
        robosuite_name: robosuite's name of the environment.
        description: one sentence, LeRobot's `task_description`.
        object_keys: robosuite 1.5's observables that make up `environment_state`, in order; robomimic's files
            `*_v15.hdf5` hold their concatenation as `obs/object`.
        object_keys_v141: the same in the order of robosuite 1.4.1, which is that of the files `*_v141.hdf5`.
        cameras: those of robomimic's image datasets.
        more_cameras: further ones that the model has.
        episode_length: robomimic's horizon of a rollout for its proficient-human data, steps.
        n_robots: number of Pandas.
        negated_in_v141: keys whose sign is the other one in robosuite 1.4.1.
    """

    robosuite_name: str
    description: str
    object_keys: tuple[str, ...]
    object_keys_v141: tuple[str, ...]
    cameras: tuple[str, ...]
    more_cameras: tuple[str, ...]
    episode_length: int
    n_robots: int = 1
    negated_in_v141: tuple[str, ...] = ()

    @property
    def agent_keys(self) -> tuple[str, ...]:
        """Observables that make up `agent_pos`, in order: those of `robot0`, then those of `robot1`."""
        return tuple(f"robot{robot}_{key}" for robot in range(self.n_robots) for key in ARM_KEYS)

    @property
    def agent_pos_dim(self) -> int:
        """Length of `agent_pos`: 9 per robot."""
        return sum(map(key_dim, self.agent_keys))

    @property
    def environment_state_dim(self) -> int:
        """Length of `environment_state`."""
        return sum(map(key_dim, self.object_keys))

    @property
    def action_dim(self) -> int:
        """Length of an action: 7 per robot."""
        return ARM_ACTION_DIM * self.n_robots


def _pose_first(name: str) -> tuple[str, ...]:
    """Order of robosuite 1.4.1."""
    return (f"{name}_pos", f"{name}_quat", f"{name}_to_robot0_eef_pos", f"{name}_to_robot0_eef_quat")


def _relative_pose_first(name: str) -> tuple[str, ...]:
    """Order of robosuite 1.5; the relative pose lies in the frame of the hand."""
    position, rotation, relative_position, relative_rotation = _pose_first(name)
    return (relative_position, relative_rotation, position, rotation)


_CUBE = ("cube_pos", "cube_quat", "gripper_to_cube_pos")
_HANGING_FLAGS = ("frame_is_assembled", "tool_on_frame")
_TRANSPORT_POSES = (
    *("payload_pos", "payload_quat", "trash_pos", "trash_quat", "lid_handle_pos", "lid_handle_quat"),
    *("target_bin_pos", "trash_bin_pos"),
)
_TRANSPORT_FLAGS = ("payload_in_target_bin", "trash_in_trash_bin")
_TRANSPORT_VECTORS = (
    *("gripper0_to_payload", "gripper0_to_lid_handle"),
    *("gripper1_to_payload", "gripper1_to_trash"),
)
_EYE = "robot0_eye_in_hand"
_ROBOT = "robot0_robotview"

TASKS: dict[str, RobomimicTask] = {
    "lift": RobomimicTask(
        robosuite_name="Lift",
        description="Lift the cube.",
        object_keys=_CUBE,
        object_keys_v141=_CUBE,
        cameras=("agentview", _EYE),
        more_cameras=("frontview", "birdview", "sideview", _ROBOT),
        episode_length=400,
        negated_in_v141=("gripper_to_cube_pos",),
    ),
    "can": RobomimicTask(
        robosuite_name="PickPlaceCan",
        description="Put the can into its compartment of the other bin.",
        object_keys=_relative_pose_first("Can"),
        object_keys_v141=_pose_first("Can"),
        cameras=("agentview", _EYE),
        more_cameras=("frontview", "birdview", _ROBOT),
        episode_length=400,
    ),
    "square": RobomimicTask(
        robosuite_name="NutAssemblySquare",
        description="Put the square nut onto the square peg.",
        object_keys=_relative_pose_first("SquareNut"),
        object_keys_v141=_pose_first("SquareNut"),
        cameras=("agentview", _EYE),
        more_cameras=("frontview", "birdview", "sideview", _ROBOT),
        episode_length=400,
    ),
    "transport": RobomimicTask(
        robosuite_name="TwoArmTransport",
        description="Hand the hammer from bin to bin and clear the trash out of its way.",
        object_keys=(*_TRANSPORT_POSES, *_TRANSPORT_FLAGS, *_TRANSPORT_VECTORS),
        object_keys_v141=(*_TRANSPORT_POSES, *_TRANSPORT_VECTORS, *_TRANSPORT_FLAGS),
        cameras=("shouldercamera0", "shouldercamera1", _EYE, "robot1_eye_in_hand"),
        more_cameras=("frontview", "birdview", "agentview", "sideview", _ROBOT, "robot1_robotview"),
        episode_length=700,
        n_robots=2,
    ),
    "tool_hang": RobomimicTask(
        robosuite_name="ToolHang",
        description="Assemble the frame on the stand and hang the tool on it.",
        object_keys=(
            *(k for n in ("base", "frame", "tool") for k in _relative_pose_first(n)),
            *_HANGING_FLAGS,
        ),
        object_keys_v141=(*(k for n in ("base", "frame", "tool") for k in _pose_first(n)), *_HANGING_FLAGS),
        cameras=("sideview", _EYE),
        more_cameras=("frontview", "birdview", "agentview", _ROBOT),
        episode_length=700,
    ),
}
"""`--env.task` to its description."""


def get_task(task: str | None) -> RobomimicTask:
    """Look a task up in `TASKS`.

    Raises:
        ValueError: if the task is not known.
    """
    if task not in TASKS:
        raise ValueError(f"--env.task must be one of {', '.join(TASKS)}; got {task!r}.")
    return TASKS[task]
