"""Another background in every episode: whether a policy has learned to look past it."""

from typing import Any

import gymnasium as gym
import numpy as np

from lerobot_agpd.envs.base import PIXELS
from lerobot_agpd.textures import MASK_SUFFIX, Textures, mask_of

STREAM = 7
"""Distinguishes the backgrounds' random numbers from the simulation's, which they leave alone."""


class Backgrounds(gym.Wrapper):
    """Shows what the environment shows before a background that lasts for an episode and follows from its seed.

    The environment's observations have a mask beside the image of every camera.
    """

    def __init__(self, env: gym.Env, textures: Textures, keep_masks: bool) -> None:
        """Wrap an environment; without `keep_masks` the masks are not passed on."""
        super().__init__(env)
        self._textures, self._keep_masks = textures, keep_masks
        self._rng = np.random.default_rng(STREAM)
        self._backgrounds: dict[str, np.ndarray] = {}
        if not keep_masks:
            spaces = dict(env.observation_space.spaces)  # type: ignore[attr-defined]  # a Dict
            images = {name: space for name, space in spaces[PIXELS].items() if not name.endswith(MASK_SUFFIX)}
            spaces[PIXELS] = gym.spaces.Dict(images)
            self.observation_space = gym.spaces.Dict(spaces)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Reset, with new backgrounds."""
        observation, info = self.env.reset(seed=seed, options=options)
        if seed is not None:
            self._rng = np.random.default_rng([STREAM, seed])
        self._backgrounds.clear()
        return self._shown(observation), info

    def step(self, action: np.ndarray) -> tuple[dict[str, Any], Any, bool, bool, dict[str, Any]]:
        """Step."""
        observation, *outcome = self.env.step(action)
        return self._shown(observation), *outcome  # type: ignore[return-value]  # reward, ends and info as they are

    def _shown(self, observation: dict[str, Any]) -> dict[str, Any]:
        shown = {}
        for name, image in observation[PIXELS].items():
            if name.endswith(MASK_SUFFIX):
                if self._keep_masks:
                    shown[name] = image
                continue
            if name not in self._backgrounds:
                self._backgrounds[name] = self._textures.draw(self._rng, *image.shape[:2])
            mask = observation[PIXELS][mask_of(name)] > 127
            shown[name] = np.where(mask, self._backgrounds[name], image)
        return {**observation, PIXELS: shown}
