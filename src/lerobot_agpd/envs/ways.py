"""Tasks that can be done in several ways, and which way an episode took."""

from abc import abstractmethod
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lerobot_agpd.envs.base import TaskSpec

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class WaysTask(TaskSpec):
    """A task with several ways, numbered from 0; no observation shows at the start which one will be taken."""

    @property
    @abstractmethod
    def n_ways(self) -> int:
        """Number of ways."""

    @abstractmethod
    def way_of(self, agent_pos: Array, environment_state: Array) -> int:
        """Way that a successful episode took.

        Args:
            agent_pos: (T, agent_pos_dim) of the episode's observations; `observation.state` in a dataset.
            environment_state: (T, environment_state_dim); `observation.environment_state` in a dataset.

        Returns:
            Number of the way, in [0, n_ways).
        """
