"""Configuration of the diffusion policy with an exchangeable denoiser."""

from __future__ import annotations

from dataclasses import dataclass, field

from lerobot.configs import NormalizationMode, PreTrainedConfig
from lerobot.optim import AdamWConfig
from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig

DENOISERS = ("mlp", "transformer", "unet")

UNUSED_DOWN_DIMS = (16,)
"""Size of the U-Net that LeRobot's DiffusionModel always builds, where another denoiser takes its place."""


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
        _check_sinusoidal("--policy.mlp.time_embed_dim", self.time_embed_dim)


@dataclass
class TransformerDenoiserConfig:
    """Size of the transformer denoiser; defaults: low-dimensional Push-T in arXiv:2303.04137 (9 M parameters)."""

    width: int = 256  # width of the tokens; the feed-forward layers are four times as wide
    n_layers: int = 8  # decoder layers over the noisy actions
    n_heads: int = 4  # attention heads per layer
    dropout: float = 0.0  # dropout of the embedded tokens
    attention_dropout: float = (
        0.01  # dropout inside the layers (attention, feed-forward and residual branches)
    )
    causal: bool = True  # an action attends to no later action and to no later observation
    n_condition_layers: int = 0  # encoder layers over the condition; 0: an MLP on every condition token

    def __post_init__(self) -> None:
        for name in ("n_layers", "n_heads"):
            if getattr(self, name) < 1:
                raise ValueError(f"--policy.transformer.{name} must be at least 1, got {getattr(self, name)}")
        for name in ("dropout", "attention_dropout"):
            if not 0 <= getattr(self, name) < 1:
                raise ValueError(f"--policy.transformer.{name} must be in [0, 1), got {getattr(self, name)}")
        if self.n_condition_layers < 0:
            raise ValueError(
                f"--policy.transformer.n_condition_layers must be at least 0, got {self.n_condition_layers}"
            )
        _check_sinusoidal("--policy.transformer.width", self.width)
        if self.width % self.n_heads:
            raise ValueError(
                f"--policy.transformer.width must be a multiple of n_heads={self.n_heads}, got {self.width}"
            )


def _check_sinusoidal(flag: str, width: int) -> None:
    if width < 4 or width % 2:
        raise ValueError(
            f"{flag} must be even and at least 4 (it holds pairs of sines and cosines), got {width}"
        )


@dataclass
class EMAConfig:
    """Exponential moving average of the weights, used for evaluation and as a teacher.

    The defaults are those of arXiv:2303.04137. Only parameters are averaged, not the running statistics of
    batch normalization: with images, that paper replaces it (`--policy.use_group_norm=true
    --policy.pretrained_backbone_weights=null`).
    """

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
    """LeRobot's diffusion policy with a choice of denoisers, averaged weights and data in memory.

    Everything that is not listed here means what it means for `--policy.type=diffusion`. The denoiser is

    - `mlp` (default): a residual MLP, cheap enough to train on a CPU, for low-dimensional observations;
    - `transformer`: DP-T of arXiv:2303.04137, which trains with weight decay on its matrices and wants a warm-up;
    - `unet`: DP-C of the same paper, LeRobot's own U-Net (`down_dims`, `kernel_size`, ...).

    The optimizer's defaults are the MLP's; examples/presets/dp_t_pusht.yaml has those of the paper's DP-T.
    """

    horizon: int = 16  # steps of a predicted chunk, the first n_obs_steps - 1 of them in the past
    n_action_steps: int = 8  # steps executed per prediction
    drop_n_last_frames: int = 7  # horizon - n_action_steps - n_obs_steps + 1
    down_dims: tuple[int, ...] | None = None  # U-Net's width per stage; default: LeRobot's for denoiser=unet
    crop_shape: tuple[int, int] | None = None

    # As LeRobot's, and observation.environment_state too, which LeRobot's diffusion policy takes as it is.
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: {
            "VISUAL": NormalizationMode.MEAN_STD,
            "STATE": NormalizationMode.MIN_MAX,
            "ENV": NormalizationMode.MIN_MAX,
            "ACTION": NormalizationMode.MIN_MAX,
        }
    )
    prediction_type: str = "sample"  # sample: the clean chunk; epsilon: the noise
    denoiser: str = "mlp"  # network that predicts the noise (or the clean chunk)
    mlp: MLPDenoiserConfig = field(default_factory=MLPDenoiserConfig)
    transformer: TransformerDenoiserConfig = field(default_factory=TransformerDenoiserConfig)
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
        if self.denoiser not in DENOISERS:
            raise ValueError(f"--policy.denoiser must be one of {list(DENOISERS)}, got '{self.denoiser}'")
        if self.down_dims is None:
            self.down_dims = DiffusionConfig.down_dims if self.denoiser == "unet" else UNUSED_DOWN_DIMS
        super().__post_init__()
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
            ValueError: if state or action are missing, images are to be gathered from memory, or LeRobot
                refuses the features.
        """
        if self.robot_state_feature is None or self.action_feature is None:
            raise ValueError(
                "a diffusion policy needs the features observation.state and action, got "
                f"{list(self.input_features or {})} and {list(self.output_features or {})}"
            )
        super().validate_features()
        self._check_memory()

    def _check_memory(self) -> None:
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
        return None if self.in_memory else self.chunk_delta_indices

    @property
    def chunk_delta_indices(self) -> list[int]:
        """Steps of a chunk relative to the current one."""
        return super().action_delta_indices
