"""Configuration of the diffusion student trained by AGPD."""

from __future__ import annotations

from dataclasses import dataclass

from lerobot.configs import PreTrainedConfig

from lerobot_agpd.config import StudentConfig
from lerobot_agpd.policies.diffusion_transformer.configuration_diffusion_transformer import (
    DiffusionTransformerConfig,
)


@PreTrainedConfig.register_subclass("agpd_diffusion")
@dataclass
class AGPDDiffusionConfig(DiffusionTransformerConfig, StudentConfig):
    """A diffusion policy (`denoiser` transformer: DP-T, unet: DP-C, or mlp) with the groups of the distillation.

    With `teacher.path` it learns from that teacher; without, from itself (self-distillation).
    """

    # Features of the demonstrations that the student sees, e.g. '["observation.state","observation.image"]'; default: all.
    # The teacher sees what it was trained on, whatever the student sees.
    inputs: list[str] | None = None

    def _check_memory(self) -> None:
        """Images are allowed: T reads those from disk."""

    @property
    def observation_delta_indices(self) -> None:  # type: ignore[override]
        """None: the loader delivers single frames, histories are cut from T."""
        return None

    @property
    def action_delta_indices(self) -> None:  # type: ignore[override]
        """None: the loader delivers single frames, chunks are cut from T."""
        return None

    @property
    def predicted_steps(self) -> int:
        """Of its chunk, LeRobot's diffusion policy returns the steps that it would execute."""
        return self.n_action_steps

    @property
    def history_length(self) -> int:
        """Observations in a history."""
        return self.n_obs_steps
