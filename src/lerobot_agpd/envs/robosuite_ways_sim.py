"""The simulation of `robosuite_ways`: a Panda of robosuite before cubes, of which it may lift any.

Faster than robosuite's own Lift: no sensors, steps of the physics of 5 ms instead of 2, and the torques of
`operational_space`.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np

from lerobot_agpd.envs.base import View
from lerobot_agpd.envs.lift_tasks import (
    CONTROLLER,
    FPS,
    HALF_CUBE,
    LIFTED,
    POSTURE,
    TABLE_HEIGHT,
    TASKS,
    LiftTask,
)
from lerobot_agpd.envs.operational_space import OperationalSpace
from lerobot_agpd.envs.rendering import ViewedEnv
from lerobot_agpd.envs.robomimic_tasks import ARM_ACTION_NAMES, ROBOT
from lerobot_agpd.envs.robosuite_sim import COLLISION_GROUP, MODEL_SEED, numpy_seeded

# isort: split
# robosuite comes last: `robosuite_sim` silences the warnings of its import.
from robosuite import macros
from robosuite.environments.manipulation.manipulation_env import ManipulationEnv
from robosuite.models.arenas import TableArena
from robosuite.models.objects import BoxObject
from robosuite.models.tasks import ManipulationTask

TIMESTEP = 0.005  # of the physics, seconds
PLACE_NOISE = 0.01  # meters in x and y, at most
COLORS = ([0.8, 0.1, 0.1, 1.0], [0.1, 0.6, 0.1, 1.0], [0.1, 0.2, 0.8, 1.0])


@contextmanager
def physics_timestep(seconds: float) -> Iterator[None]:
    """Build robosuite's environments with another time step than its global one."""
    usual = macros.SIMULATION_TIMESTEP
    macros.SIMULATION_TIMESTEP = seconds
    try:
        yield
    finally:
        macros.SIMULATION_TIMESTEP = usual


class CubesOnTable(ManipulationEnv):
    """robosuite's Lift with the cubes of a task."""

    def __init__(self, task: LiftTask) -> None:
        """Build the model."""
        self.task = task
        super().__init__(
            robots=ROBOT,
            controller_configs={"type": "BASIC", "body_parts": {"right": CONTROLLER}},
            control_freq=FPS,
            ignore_done=True,
            hard_reset=False,
            lite_physics=True,
            use_camera_obs=False,
            has_renderer=False,
            has_offscreen_renderer=False,
            renderer="mujoco",
        )

    def _load_model(self) -> None:
        super()._load_model()
        (robot,) = self.robots
        robot.init_qpos = np.array(POSTURE)
        size = (0.8, 0.8, 0.05)
        robot.robot_model.set_base_xpos(robot.robot_model.base_xpos_offset["table"](size[0]))
        arena = TableArena(size, table_offset=(0.0, 0.0, TABLE_HEIGHT))
        arena.set_origin([0, 0, 0])
        self.cubes = [
            BoxObject(name=f"cube_{i}", size=[HALF_CUBE] * 3, rgba=COLORS[i % len(COLORS)])
            for i in range(len(self.task.cubes))
        ]
        self.model = ManipulationTask(arena, [robot.robot_model], self.cubes)

    def _setup_references(self) -> None:
        super()._setup_references()
        self.cube_ids = [self.sim.model.body_name2id(cube.root_body) for cube in self.cubes]

    def _reset_internal(self) -> None:
        super()._reset_internal()
        (robot,) = self.robots
        self._operational_space = OperationalSpace(robot.part_controllers["right"], self.sim.model._model)
        self._arm, self._gripper = (
            robot._ref_actuators_indexes_dict[part] for part in ("right", "right_gripper")
        )
        self._torque_limits = self.sim.model.actuator_ctrlrange[self._arm].T
        for cube, place in zip(self.cubes, self.task.cubes, strict=True):
            x, y = place + np.random.uniform(-PLACE_NOISE, PLACE_NOISE, 2)
            self.sim.data.set_joint_qpos(cube.joints[0], [x, y, TABLE_HEIGHT + HALF_CUBE, 1, 0, 0, 0])

    def _pre_action(self, action: np.ndarray, policy_step: bool = False) -> None:
        """Let the controllers act as `FixedBaseRobot.control` does, without its records of the past."""
        (robot,), sim = self.robots, self.sim
        if policy_step:
            robot.part_controllers["right"].new_update = True
            robot.composite_controller.set_goal(action)
            sim.data.ctrl[self._gripper] = robot.part_controllers["right_gripper"].run_controller()
        sim.data.ctrl[self._arm] = np.clip(
            self._operational_space.torques(sim.data._data), *self._torque_limits
        )

    def _setup_observables(self) -> dict[str, Any]:
        """None: `LiftWays` reads the simulation itself."""
        return {}

    @property
    def cube_positions(self) -> np.ndarray:
        """Centers (N, 3) of the cubes, meters."""
        return np.asarray(self.sim.data.body_xpos[self.cube_ids])

    def reward(self, action: Any = None) -> float:
        """1 if a cube is lifted."""
        return float(self._check_success())

    def _check_success(self) -> bool:
        return bool(self.cube_positions[:, 2].max() > TABLE_HEIGHT + LIFTED)


class LiftWays(ViewedEnv):
    """One task of `lift_tasks.TASKS` with LeRobot's raw keys.

    `agent_pos` (9,) is the position of the hand, its quaternion (x y z w) and its two fingers, as in robomimic's lift;
    `environment_state` the vectors from the hand to all cubes. Lifting any ends the episode with
    `info["is_success"]`.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": FPS}
    render_mode = "rgb_array"
    action_names = ARM_ACTION_NAMES

    def __init__(self, task: str, view: View | None = None) -> None:
        """Build the simulation of a key of `lift_tasks.TASKS`; no graphics context is opened before the first image."""
        self.task, self.spec_of_task = task, TASKS[task]
        with numpy_seeded(MODEL_SEED), physics_timestep(TIMESTEP):
            self.simulation = CubesOnTable(self.spec_of_task)
        self.set_view(view or View(), self.spec_of_task, hidden_group=COLLISION_GROUP)
        self.main_camera = "agentview"
        self.action_space = gym.spaces.Box(-1.0, 1.0, (self.spec_of_task.action_dim,), dtype=np.float32)

    def scene(self) -> tuple[mujoco.MjModel, mujoco.MjData]:
        """Model and data of the simulation."""
        return self.simulation.sim.model._model, self.simulation.sim.data._data

    def _read(self) -> dict[str, Any]:
        (robot,), data = self.simulation.robots, self.simulation.sim.data
        hand = np.array(data.site_xpos[robot.eef_site_id["right"]])
        w, x, y, z = data.body_xquat[
            self.simulation.sim.model.body_name2id(robot.robot_model.eef_name["right"])
        ]
        fingers = data.qpos[robot._ref_gripper_joint_pos_indexes["right"]]
        vectors = self.simulation.cube_positions - hand
        return self.observe(np.concatenate([hand, [x, y, z, w], fingers]), vectors.ravel())

    @property
    def is_success(self) -> bool:
        """Whether a cube is lifted."""
        return self.simulation._check_success()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Put the cubes where the seed says, or without one the last seed."""
        super().reset(seed=seed)
        with numpy_seeded(int(self.np_random.integers(2**32))), physics_timestep(TIMESTEP):
            self.simulation.reset()
        sim, (robot,) = self.simulation.sim, self.simulation.robots
        sim.data.qacc_warmstart[:] = 0.0
        sim.forward()
        robot.part_controllers["right"].update_initial_joints(sim.data.qpos[robot._ref_arm_joint_pos_indexes])
        return self._read(), {"is_success": self.is_success}

    def step(self, action: np.ndarray) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """One control step of 50 ms; the reward is 1 if a cube is lifted and 0 otherwise."""
        self.simulation.step(np.asarray(action, dtype=np.float64))
        model, data = self.scene()
        mujoco.mj_kinematics(
            model, data
        )  # robosuite leaves the positions at those before its last step of physics
        mujoco.mj_comPos(model, data)
        mujoco.mj_camlight(model, data)
        success = self.is_success
        return self._read(), float(success), success, False, {"is_success": success}

    def close(self) -> None:
        """Free the graphics contexts and the simulation."""
        super().close()
        self.simulation.close()
