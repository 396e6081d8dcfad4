"""What a simulation shows: its raw observations, and images from MuJoCo's own renderer at several sizes.

gymnasium's renderer draws several environments of one process into each other. robosuite's opens its graphics context
when the environment is built, needs it for every reset and delivers images upside down. Here a context is opened at
the first image of a size, and each is made current before use.
"""

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np

from lerobot_agpd.envs.base import AGENT_POS, ENVIRONMENT_STATE, PIXELS, TaskSpec, View
from lerobot_agpd.envs.poses import CameraPose
from lerobot_agpd.textures import mask_of

type Camera = mujoco.MjvCamera | int | str
"""A camera, or the number or name of one of the model's."""


def free_camera(pose: CameraPose) -> mujoco.MjvCamera:
    """Camera at a pose."""
    camera = mujoco.MjvCamera()
    camera.distance, camera.azimuth, camera.elevation = pose.distance, pose.azimuth, pose.elevation
    camera.lookat[:] = pose.lookat
    return camera


class SceneRenderer:
    """Renders scenes of one model.

    Attributes:
        renderers: one per size of image that has been rendered, with a graphics context each.
    """

    def __init__(self, shadows: bool, hidden_group: int | None, antialiasing: bool = True) -> None:
        """Open no graphics context yet.

        Args:
            shadows: whether to draw shadows.
            hidden_group: group of geometry that is not drawn.
            antialiasing: whether to draw smooth edges.
        """
        self._shadows, self._antialiasing = shadows, antialiasing
        self._option = mujoco.MjvOption()
        if hidden_group is not None:
            self._option.geomgroup[hidden_group] = 0
        self.renderers: dict[tuple[int, int], mujoco.Renderer] = {}

    def render(
        self, model: mujoco.MjModel, data: mujoco.MjData, camera: Camera, size: tuple[int, int]
    ) -> np.ndarray:
        """Render the current state.

        Args:
            model: the same model as at the last call; for another one, `close` first.
            data: state of the simulation.
            camera: where to look from.
            size: height and width, pixels.

        Returns:
            (height, width, 3) uint8.
        """
        if size not in self.renderers:
            buffer = model.vis.global_
            buffer.offheight, buffer.offwidth = max(buffer.offheight, size[0]), max(buffer.offwidth, size[1])
            if not self._antialiasing:
                model.vis.quality.offsamples = 0  # read when a context is opened
            self.renderers[size] = mujoco.Renderer(model, *size)
            self.renderers[size].scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = self._shadows
        renderer = self.renderers[size]
        renderer.update_scene(data, camera, self._option)
        return renderer.render()

    def background(
        self, model: mujoco.MjModel, data: mujoco.MjData, camera: Camera, size: tuple[int, int]
    ) -> np.ndarray:
        """Mask (height, width, 3) in uint8 of the image that was rendered last: 255 where nothing can move.

        That is the sky, and geometry that is welded to the world.
        """
        renderer = self.renderers[size]
        renderer.enable_segmentation_rendering()
        renderer.update_scene(data, camera, self._option)
        number, kind = np.moveaxis(renderer.render(), -1, 0)
        renderer.disable_segmentation_rendering()
        fixed = model.body_weldid[model.geom_bodyid] == 0  # (geometries,)
        is_background = (kind == -1) | ((kind == mujoco.mjtObj.mjOBJ_GEOM) & fixed[number])
        return np.repeat(np.uint8(255) * is_background[..., None], 3, axis=-1)

    def close(self) -> None:
        """Free the graphics contexts; the next image opens one again."""
        for renderer in self.renderers.values():
            renderer.close()
        self.renderers.clear()


class ViewedEnv(gym.Env):
    """A simulation that shows what a view says.

    Attributes:
        view: what is shown.
        state: `agent_pos` and `environment_state` of the last observation, whatever the view shows: for experts.
        main_camera: camera of rendered frames, and of an observed image without a name.
        cameras: those observed cameras that are not the model's, by name.
        task_description: one sentence, for LeRobot.
        action_names: of the action's dimensions, for pictures; empty: they have none.
    """

    view: View
    state: dict[str, np.ndarray]
    main_camera: Camera = "top"
    cameras: dict[str, mujoco.MjvCamera]
    task_description: str
    action_names: Sequence[str] = ()

    def set_view(self, view: View, spec: TaskSpec, hidden_group: int | None = None) -> None:
        """Declare the observations of a task; `hidden_group` of the model's geometry is in no image."""
        self.view, self.state = view, {}
        self.task_description = spec.description
        self.scene_renderer = SceneRenderer(view.shadows, hidden_group, view.antialiasing)
        self.cameras = {name: free_camera(pose) for name, pose in view.poses.items()}
        if view.main_pose is not None:
            self.main_camera = free_camera(view.main_pose)
        image = gym.spaces.Box(0, 255, (*view.observation_size, 3), np.uint8)
        spaces: dict[str, gym.Space] = {
            AGENT_POS: gym.spaces.Box(-np.inf, np.inf, (spec.agent_pos_dim,), np.float32),
            ENVIRONMENT_STATE: gym.spaces.Box(-np.inf, np.inf, (spec.environment_state_dim,), np.float32),
            PIXELS: gym.spaces.Dict(dict.fromkeys(view.image_names, image)) if view.cameras else image,
        }
        self.observation_space = gym.spaces.Dict({key: spaces[key] for key in view.keys})

    def observe(self, agent_pos: np.ndarray, environment_state: np.ndarray) -> dict[str, Any]:
        """Return the raw observation: float32 vectors, and images (height, width, 3) in uint8 if the view has any."""
        vectors = {AGENT_POS: agent_pos, ENVIRONMENT_STATE: environment_state}
        self.state = {key: vector.astype(np.float32) for key, vector in vectors.items()}
        observation: dict[str, Any] = {key: self.state[key] for key in self.view.keys if key != PIXELS}
        if PIXELS in self.view.keys:
            observation[PIXELS] = self._pixels(*self.scene())
        return observation

    def _pixels(self, model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray | dict[str, np.ndarray]:
        """The observed image of the main camera, or those of the named cameras and their masks."""
        renderer, size = self.scene_renderer, self.view.observation_size
        if not self.view.cameras:
            return renderer.render(model, data, self.main_camera, size)
        images = {}
        for name in self.view.cameras:
            camera = self.cameras.get(name, name)
            images[name] = renderer.render(model, data, camera, size)
            if self.view.masks:
                images[mask_of(name)] = renderer.background(model, data, camera, size)
        return images

    def render(self) -> np.ndarray:
        """Render a frame (height, width, 3) of the main camera."""
        return self.scene_renderer.render(*self.scene(), self.main_camera, self.view.visualization_size)

    @abstractmethod
    def scene(self) -> tuple[mujoco.MjModel, mujoco.MjData]:
        """Model and data of the simulation, as they shall be drawn."""

    def close(self) -> None:
        """Free the graphics contexts and the simulation."""
        self.scene_renderer.close()
        super().close()
