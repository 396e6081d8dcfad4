"""Configuration of the diffusion policy with an exchangeable denoiser."""

from __future__ import annotations

from dataclasses import dataclass, field

from lerobot.configs import PreTrainedConfig
from lerobot.optim import AdamWConfig
from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig

DENOISERS = ("mlp",)


@dataclass
class MLPDenoiserConfig:
    """Size of the residual MLP denoiser."""

    width: int = 640  # width of every residual block
    n_blocks: int = 4  # number of residual blocks, two linear layers each
    time_embed_dim: int = 64  # width of the diffusion step's sinusoidal embedding

    def __post_init__(self) -> None:
        for name in ("width", "n_blocks", "time_embed_dim"):
            if getattr(self, name) < 1:
                raise ValueError(f"--policy.mlp.{name} must be at least 1, got {getattr(self, name)}")


@dataclass
class EMAConfig:
    """Exponential moving average of the weights, used for evaluation and as a teacher."""

    enable: bool = True  # keep averaged weights and save them as the policy's weights
    power: float = 0.75  # the decay after n steps is 1 - (1 + n) ** -power
    max_decay: float = 0.9999  # upper limit of the decay

    def __post_init__(self) -> None:
        if not 0 < self.power <= 1:
            raise ValueError(f"--policy.ema.power must be in (0, 1], got {self.power}")
        if not 0 <= self.max_decay < 1:
            raise ValueError(f"--policy.ema.max_decay must be in [0, 1), got {self.max_decay}")


@PreTrainedConfig.register_subclass("diffusion_transformer")
@dataclass
class DiffusionTransformerConfig(DiffusionConfig):
    """LeRobot's diffusion policy with its U-Net exchanged for a denoiser that is cheap on a CPU.

    Everything that is not listed here means what it means for `--policy.type=diffusion`. `down_dims` only
    sizes the U-Net that LeRobot builds and that is thrown away at once.
    """

    horizon: int = 16  # steps of a predicted chunk, the first n_obs_steps - 1 of them in the past
    n_action_steps: int = 8  # steps executed per prediction
    drop_n_last_frames: int = 7  # horizon - n_action_steps - n_obs_steps + 1
    down_dims: tuple[int, ...] = (16,)
    crop_shape: tuple[int, int] | None = None

    prediction_type: str = "sample"  # sample: the clean chunk; epsilon: the noise
    denoiser: str = "mlp"  # network that predicts the noise (or the clean chunk)
    mlp: MLPDenoiserConfig = field(default_factory=MLPDenoiserConfig)
    ema: EMAConfig = field(default_factory=EMAConfig)
    in_memory: bool = (
        True  # cut chunks from columns in memory; false: LeRobot's loader delivers them (needed for images)
    )
    noise_samples_per_frame: int = (
        4  # noise levels drawn for every delivered frame, so that loading costs less
    )

    optimizer_lr: float = 5e-4
    optimizer_betas: tuple = (0.9, 0.999)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.denoiser not in DENOISERS:
            raise ValueError(f"--policy.denoiser must be one of {list(DENOISERS)}, got '{self.denoiser}'")
        if self.noise_samples_per_frame < 1:
            raise ValueError(
                f"--policy.noise_samples_per_frame must be at least 1, got {self.noise_samples_per_frame}"
            )
        usable = self.horizon - self.n_obs_steps + 1
        if self.n_action_steps > usable:
            raise ValueError(
                f"--policy.n_action_steps={self.n_action_steps} exceeds the {usable} steps that horizon "
                f"{self.horizon} leaves from the current step on with n_obs_steps {self.n_obs_steps}"
            )

    def get_optimizer_preset(self) -> AdamWConfig:
        """AdamW with decoupled weight decay."""
        return AdamWConfig(
            lr=self.optimizer_lr,
            betas=self.optimizer_betas,
            eps=self.optimizer_eps,
            weight_decay=self.optimizer_weight_decay,
        )

    def validate_features(self) -> None:
        """Check the features.

        Raises:
            ValueError: if images are to be gathered from memory, or LeRobot refuses the features.
        """
        super().validate_features()
        if self.in_memory and self.image_features:
            raise ValueError(
                f"--policy.in_memory=true holds no images, but the inputs are {list(self.image_features)}; "
                "pass --policy.in_memory=false to let LeRobot's loader deliver histories and chunks"
            )

    @property
    def observation_delta_indices(self) -> list | None:
        """Observation history asked of the loader; None if it is cut from memory."""
        return None if self.in_memory else super().observation_delta_indices

    @property
    def action_delta_indices(self) -> list | None:
        """Action chunk asked of the loader; None if it is cut from memory."""
        return None if self.in_memory else self.chunk_offsets

    @property
    def chunk_offsets(self) -> list[int]:
        """Steps of a chunk relative to the current one."""
        return super().action_delta_indices
