"""Images of a robosuite simulation, from MuJoCo's own renderer.

robosuite can render by itself, but opens its graphics context when the environment is built, needs it for every
reset and delivers images upside down, which robomimic turns over. Here a context is opened at the first image of a
size. What is drawn is the same, pixel for pixel: visual geometry without collision geometry.
"""

from typing import Any

import mujoco
import numpy as np

COLLISION_GROUP = 0
"""robosuite's group of the geometry that collides; the one that is seen is in group 1."""


class SceneCameras:
    """The named cameras of a simulation, at any size."""

    def __init__(self) -> None:
        """Open no graphics context yet."""
        self._renderers: dict[tuple[int, int], mujoco.Renderer] = {}
        self._option = mujoco.MjvOption()
        self._option.geomgroup[COLLISION_GROUP] = 0

    @property
    def is_open(self) -> bool:
        """Whether an image has been rendered."""
        return bool(self._renderers)

    def render(self, sim: Any, camera: str, size: tuple[int, int]) -> np.ndarray:
        """Render the current state.

        Args:
            sim: robosuite's `MjSim`; after another model was loaded into it, `close` first.
            camera: name of the camera.
            size: height and width, pixels.

        Returns:
            (height, width, 3) uint8, the right way up.
        """
        if size not in self._renderers:
            self._renderers[size] = self._open(sim.model._model, size)
        renderer = self._renderers[size]
        renderer.update_scene(sim.data._data, camera, self._option)
        return renderer.render()

    def _open(self, model: mujoco.MjModel, size: tuple[int, int]) -> mujoco.Renderer:
        height, width = size
        buffer = model.vis.global_
        buffer.offheight = max(buffer.offheight, height)
        buffer.offwidth = max(buffer.offwidth, width)
        return mujoco.Renderer(model, height, width)

    def close(self) -> None:
        """Free the graphics contexts; the next image opens one again."""
        for renderer in self._renderers.values():
            renderer.close()
        self._renderers.clear()
