"""Any other policy that predicts chunks as a teacher: it acts alone or mixed with the student, unguided."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from lerobot_agpd.flag_checks import require
from lerobot_agpd.guidance.guide import Guide
from lerobot_agpd.guidance.teacher import Teacher, seeded_by


class ChunkTeacher(Teacher):
    """A policy of one observation, sampled by LeRobot's `predict_action_chunk`; its chunk starts now."""

    can_be_guided = False

    def __init__(self, *args: Any):
        """Refuse policies that look at more than one observation."""
        super().__init__(*args)
        require(
            self.n_obs_steps == 1,
            f"the {self.type} teacher looks at {self.n_obs_steps} observations, and LeRobot's "
            "predict_action_chunk has no common way to pass them; register an adapter for it (docs/teachers.md)",
        )

    @property
    def n_chunk_steps(self) -> int:
        """Steps of a chunk: `chunk_size`, or for policies without one the steps they execute."""
        return getattr(self.policy.config, "chunk_size", self.n_action_steps)

    def _sample_chunk(
        self, batch: dict[str, Tensor], guide: Guide | None, generator: torch.Generator | None
    ) -> Tensor:
        with seeded_by(generator):
            chunk = self.policy.predict_action_chunk(self._now(batch))
        if chunk.ndim != 3 or chunk.shape[1] < self.n_chunk_steps:
            raise ValueError(
                f"predict_action_chunk of the {self.type} teacher returned shape {tuple(chunk.shape)}; chunks are "
                f"(B, {self.n_chunk_steps} or more, A)"
            )
        return chunk
