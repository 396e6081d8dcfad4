"""Images of a MuJoCo scene, from MuJoCo's own renderer, at several sizes.

gymnasium's renderer draws several environments of one process into each other. robosuite's opens its graphics context
when the environment is built, needs it for every reset and delivers images upside down. Here a context is opened at
the first image of a size, and each is made current before use.
"""

import mujoco
import numpy as np


class SceneRenderer:
    """Renders scenes of one model."""

    def __init__(self, shadows: bool = True, hidden_group: int | None = None) -> None:
        """Open no graphics context yet.

        Args:
            shadows: whether to draw shadows; without a GPU they take most of the time.
            hidden_group: group of geometry that is not drawn.
        """
        self._shadows = shadows
        self._option = mujoco.MjvOption()
        if hidden_group is not None:
            self._option.geomgroup[hidden_group] = 0
        self._renderers: dict[tuple[int, int], mujoco.Renderer] = {}

    @property
    def is_open(self) -> bool:
        """Whether an image has been rendered."""
        return bool(self._renderers)

    def render(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        camera: mujoco.MjvCamera | int | str,
        size: tuple[int, int],
    ) -> np.ndarray:
        """Render the current state.

        Args:
            model: the same model as at the last call; for another one, `close` first.
            data: state of the simulation.
            camera: a camera, or the number or name of one of the model's.
            size: height and width, pixels.

        Returns:
            (height, width, 3) uint8.
        """
        if size not in self._renderers:
            buffer = model.vis.global_
            buffer.offheight, buffer.offwidth = max(buffer.offheight, size[0]), max(buffer.offwidth, size[1])
            self._renderers[size] = mujoco.Renderer(model, *size)
            self._renderers[size].scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = self._shadows
        renderer = self._renderers[size]
        renderer.update_scene(data, camera, self._option)
        return renderer.render()

    def close(self) -> None:
        """Free the graphics contexts; the next image opens one again."""
        for renderer in self._renderers.values():
            renderer.close()
        self._renderers.clear()
