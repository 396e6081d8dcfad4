"""robomimic's tasks in robosuite 1.5, as gymnasium environments with LeRobot's raw keys.

The settings are those of robomimic's datasets for robosuite 1.5, with one exception: the files say `lite_physics`
false; true gives the same numbers, bit for bit, in less time.
"""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np

from lerobot_agpd.envs.base import View
from lerobot_agpd.envs.rendering import ViewedEnv
from lerobot_agpd.envs.robomimic_tasks import ARM_ACTION_NAMES, ARM_CONTROLLER, FPS, ROBOT, TASKS

# robosuite warns at import of optional packages and of a settings file that hardly anybody has. Its logger sets its
# own level during the import, which only a filter survives.
logging.getLogger("robosuite_logs").addFilter(lambda record: record.levelno >= logging.ERROR)

import robosuite  # noqa: E402

COLLISION_GROUP = 0
"""robosuite's group of the geometry that collides; what is visible is in group 1."""

MODEL_SEED = 0
"""Seed of the model: robosuite draws parts of it, such as the size of lift's cube, when it is built."""


@contextmanager
def numpy_seeded(seed: int) -> Iterator[None]:
    """Seed numpy's global generator, from which robosuite 1.5.1 draws, and restore it afterwards."""
    state = np.random.get_state()
    np.random.seed(seed)
    try:
        yield
    finally:
        np.random.set_state(state)


class RobosuiteEnv(ViewedEnv):
    """One task of `robomimic_tasks.TASKS`.

    `agent_pos` and `environment_state` are float32 vectors, `pixels` one uint8 image (height, width, 3) per camera. An
    action holds 7 numbers in [-1, 1] per robot, see `robomimic_tasks.ARM_ACTION_DIM`. The reward is 1 at success, at
    which the episode terminates, else 0. `info["is_success"]` is a bool after every step and every reset.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": FPS}
    render_mode = "rgb_array"

    def __init__(self, task: str, view: View | None = None) -> None:
        """Build the simulation; no graphics context is opened before the first image.

        Args:
            task: key of `TASKS`.
            view: what to observe; the state by default.
        """
        self.task, self.spec_of_task = task, TASKS[task]
        with numpy_seeded(MODEL_SEED):
            self.simulation = self._build()
        self.set_view(view or View(), self.spec_of_task, hidden_group=COLLISION_GROUP)
        self.main_camera = self.spec_of_task.cameras[0]
        self.action_space = gym.spaces.Box(-1.0, 1.0, (self.spec_of_task.action_dim,), dtype=np.float32)
        self.action_names = ARM_ACTION_NAMES * self.spec_of_task.n_robots
        self._has_foreign_model = False

    def _build(self) -> Any:
        controller = {"type": "BASIC", "body_parts": {"right": ARM_CONTROLLER}}
        return robosuite.make(
            self.spec_of_task.robosuite_name,
            robots=[ROBOT] * self.spec_of_task.n_robots,
            controller_configs=[controller] * self.spec_of_task.n_robots,
            control_freq=FPS,
            reward_shaping=False,
            ignore_done=True,
            hard_reset=False,
            lite_physics=True,
            use_object_obs=True,
            use_camera_obs=False,
            has_renderer=False,
            has_offscreen_renderer=False,
            renderer="mujoco",
        )

    def _read(self) -> dict[str, Any]:
        """Read the sensors once, now; robosuite's own clock of them drifts.

        A reading of can, square and tool_hang computes the relative pose from where the object was at the reading
        before. So do robomimic's data, which were read once per control step: see `step`.
        """
        raw = self.simulation._get_observations(force_update=True)
        agent_pos = np.concatenate([raw[key] for key in self.spec_of_task.agent_keys])
        return self.observe(agent_pos, raw["object-state"])

    @property
    def is_success(self) -> bool:
        """Whether the task is done in the current state, by robosuite's own check."""
        return bool(self.simulation._check_success())

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Reset to a start that follows from the seed, or without one from the last seed."""
        super().reset(seed=seed)
        if self._has_foreign_model:
            self._restore_model()
        with numpy_seeded(int(self.np_random.integers(2**32))):
            self.simulation.reset()
        return self._begin()

    def _begin(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """Make the episode a function of the current positions and velocities alone.

        Reset the warm start of the contact solver, the resting posture of the controllers and the last readings of
        the sensors.
        """
        sim = self.simulation.sim
        sim.data.qacc_warmstart[:] = 0.0
        sim.forward()
        for robot in self.simulation.robots:
            resting_posture = sim.data.qpos[robot._ref_arm_joint_pos_indexes]
            robot.part_controllers["right"].update_initial_joints(resting_posture)
        self.simulation._update_observables(force=True)
        return self._read(), {"is_success": self.is_success}

    def step(self, action: np.ndarray) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """One control step of 50 ms."""
        last_reading = dict(self.simulation._obs_cache)
        _, reward, _, _ = self.simulation.step(np.asarray(action, dtype=np.float64))
        self.simulation._obs_cache.update(last_reading)  # forget readings within the step
        success = self.is_success
        return self._read(), float(reward), success, False, {"is_success": success}

    def get_state(self) -> np.ndarray:
        """Return MuJoCo's state (1 + nq + nv,): time, positions, velocities; robomimic's HDF5 `states`."""
        return np.asarray(self.simulation.sim.get_state().flatten())

    def reset_to(
        self, state: np.ndarray, model_xml: str | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Reset to a recorded state.

        The first state of an episode, continued with the episode's actions, reproduces it. Later states do so only
        nearly: the arm's resting posture, which its redundant joint is drawn to, is taken from `state`.

        Args:
            state: (1 + nq + nv,) of `get_state` or of robomimic's `states`.
            model_xml: the model it was recorded with (HDF5: attribute `model_file` of a demonstration), which
                lasts until the next `reset`; without it, the current one.

        Returns:
            Observation and info, as `reset` does.

        Raises:
            ValueError: if the state does not have the model's length.
        """
        if model_xml is not None:
            self.scene_renderer.close()
            self._has_foreign_model = True
            self.simulation.reset_from_xml_string(self.simulation.edit_model_xml(model_xml))
        expected = self.get_state().shape
        if state.shape != expected:
            raise ValueError(f"A state of {self.task} has the shape {expected}, got {state.shape}.")
        self.simulation.deterministic_reset = True  # controllers and sensors, without drawing a start
        self.simulation.reset()
        self.simulation.deterministic_reset = False
        self.simulation.sim.set_state_from_flattened(state)
        return self._begin()

    def _restore_model(self) -> None:
        """Build the task's own model again, after one that `reset_to` loaded."""
        self.scene_renderer.close()
        self.simulation.hard_reset = True
        with numpy_seeded(MODEL_SEED):
            self.simulation.reset()
        self.simulation.hard_reset = False
        self._has_foreign_model = False

    def scene(self) -> tuple[mujoco.MjModel, mujoco.MjData]:
        """Model and data of the simulation."""
        return self.simulation.sim.model._model, self.simulation.sim.data._data

    def close(self) -> None:
        """Free the graphics contexts and the simulation."""
        super().close()
        self.simulation.close()
