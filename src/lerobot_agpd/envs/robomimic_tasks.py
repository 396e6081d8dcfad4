"""The tasks of robomimic (arXiv:2108.03298) that `--env.type=robosuite_robomimic` has, as a table without a simulator.

`agent_pos` is the concatenation of `RobomimicTask.agent_keys` (HDF5: `obs/<key>`), `environment_state` that of
`RobomimicTask.object_keys` (HDF5: one array, `obs/object`).

Horizons and cameras are robomimic's (v0.5.0: `robomimic/__init__.py` and
`robomimic/scripts/extract_obs_from_raw_datasets.sh`), object keys robosuite's own observables.
"""

from dataclasses import dataclass
from typing import Any

from lerobot_agpd.envs.base import TaskSpec

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

ARM_ACTION_NAMES = ("move x", "move y", "move z", "turn x", "turn y", "turn z", "gripper")
"""The same, for pictures."""

ARM_KEYS = ("eef_pos", "eef_quat", "gripper_qpos")
"""Observables of an arm for robomimic's low-dimensional policies, in its order, without the prefix `robot0_` or `robot1_`."""


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


@dataclass(frozen=True, kw_only=True)
class RobomimicTask(TaskSpec):
    """Properties of one task; the defaults are those of one arm.

    Attributes:
        robosuite_name: robosuite's name of the environment.
        object_keys: robosuite 1.5's observables that make up `environment_state`, in order; robomimic's files
            `*_v15.hdf5` hold their concatenation as `obs/object`.
        object_keys_v141: the same in the order of robosuite 1.4.1, which is that of the files `*_v141.hdf5`.
        cameras: those of robomimic's image datasets.
        more_cameras: further ones that the model has.
        episode_length: robomimic's horizon of a rollout for its proficient-human data, steps.
        n_robots: number of Pandas.
    """

    robosuite_name: str
    object_keys: tuple[str, ...]
    object_keys_v141: tuple[str, ...]
    cameras: tuple[str, ...]
    more_cameras: tuple[str, ...]
    fps: int = FPS
    episode_length: int = 400
    n_robots: int = 1
    action_dim: int = ARM_ACTION_DIM
    agent_pos_dim: int = 9

    @property
    def agent_keys(self) -> tuple[str, ...]:
        """Observables that make up `agent_pos`, in order: those of `robot0`, then those of `robot1`."""
        return tuple(f"robot{robot}_{key}" for robot in range(self.n_robots) for key in ARM_KEYS)


def _poses_v141(*names: str) -> tuple[str, ...]:
    """Poses of objects in the order of robosuite 1.4.1."""
    suffixes = ("pos", "quat", "to_robot0_eef_pos", "to_robot0_eef_quat")
    return tuple(f"{name}_{suffix}" for name in names for suffix in suffixes)


def _poses(*names: str) -> tuple[str, ...]:
    """Poses of objects in the order of robosuite 1.5: the relative pose, which lies in the frame of the hand, first."""
    suffixes = ("to_robot0_eef_pos", "to_robot0_eef_quat", "pos", "quat")
    return tuple(f"{name}_{suffix}" for name in names for suffix in suffixes)


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
        description="Lift the cube.",
        robosuite_name="Lift",
        environment_state_dim=10,
        object_keys=("cube_pos", "cube_quat", "gripper_to_cube_pos"),
        object_keys_v141=("cube_pos", "cube_quat", "gripper_to_cube_pos"),  # the last of opposite sign
        cameras=("agentview", _EYE),
        more_cameras=("frontview", "birdview", "sideview", _ROBOT),
    ),
    "can": RobomimicTask(
        description="Put the can into its compartment of the other bin.",
        robosuite_name="PickPlaceCan",
        environment_state_dim=14,
        object_keys=_poses("Can"),
        object_keys_v141=_poses_v141("Can"),
        cameras=("agentview", _EYE),
        more_cameras=("frontview", "birdview", _ROBOT),
    ),
    "square": RobomimicTask(
        description="Put the square nut onto the square peg.",
        robosuite_name="NutAssemblySquare",
        environment_state_dim=14,
        object_keys=_poses("SquareNut"),
        object_keys_v141=_poses_v141("SquareNut"),
        cameras=("agentview", _EYE),
        more_cameras=("frontview", "birdview", "sideview", _ROBOT),
    ),
    "transport": RobomimicTask(
        description="Hand the hammer from bin to bin and clear the trash out of its way.",
        robosuite_name="TwoArmTransport",
        n_robots=2,
        action_dim=14,
        agent_pos_dim=18,
        environment_state_dim=41,
        object_keys=(*_TRANSPORT_POSES, *_TRANSPORT_FLAGS, *_TRANSPORT_VECTORS),
        object_keys_v141=(*_TRANSPORT_POSES, *_TRANSPORT_VECTORS, *_TRANSPORT_FLAGS),
        cameras=("shouldercamera0", "shouldercamera1", _EYE, "robot1_eye_in_hand"),
        more_cameras=("frontview", "birdview", "agentview", "sideview", _ROBOT, "robot1_robotview"),
        episode_length=700,
    ),
    "tool_hang": RobomimicTask(
        description="Assemble the frame on the stand and hang the tool on it.",
        robosuite_name="ToolHang",
        environment_state_dim=44,
        object_keys=(*_poses("base", "frame", "tool"), *_HANGING_FLAGS),
        object_keys_v141=(*_poses_v141("base", "frame", "tool"), *_HANGING_FLAGS),
        cameras=("sideview", _EYE),
        more_cameras=("frontview", "birdview", "agentview", _ROBOT),
        episode_length=700,
    ),
}
"""`--env.task` to its description."""
