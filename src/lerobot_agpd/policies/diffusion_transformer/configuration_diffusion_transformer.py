"""Configuration of the diffusion policy with an exchangeable denoiser."""

from __future__ import annotations

from dataclasses import dataclass, field

from lerobot.configs import NormalizationMode, PreTrainedConfig
from lerobot.optim import AdamWConfig
from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig

from lerobot_agpd.flag_checks import require, require_at_least, require_scheduler

UNUSED_DOWN_DIMS = (16,)
"""Size of the U-Net that LeRobot's DiffusionModel always builds, where another denoiser replaces it."""

DENOISERS = ("mlp", "transformer", "unet")
"""No Literal type: argparse would hold the flags of the same name of all other policy types to it."""


@dataclass
class MLPDenoiserConfig:
    """Size of the residual MLP denoiser."""

    # Width of every residual block.
    width: int = 640
    # Number of residual blocks, two linear layers each.
    n_blocks: int = 4

    def __post_init__(self) -> None:
        for name in ("width", "n_blocks"):
            value = getattr(self, name)
            require(value >= 1, f"--policy.mlp.{name} must be at least 1, got {value}")


@dataclass
class TransformerDenoiserConfig:
    """Size of the transformer denoiser; defaults: low-dimensional Push-T in arXiv:2303.04137 (9 M parameters)."""

    # Width of the tokens; the feed-forward layers are four times as wide.
    width: int = 256
    # Decoder layers over the noisy actions.
    n_layers: int = 8
    # Attention heads per layer.
    n_heads: int = 4
    # Dropout of the embedded tokens.
    dropout: float = 0.0
    # Dropout inside the layers: attention, feed-forward and residual branches.
    attention_dropout: float = 0.01
    # An action attends to no later action and to no later observation.
    causal: bool = True

    def __post_init__(self) -> None:
        for name in ("n_layers", "n_heads"):
            value = getattr(self, name)
            require(value >= 1, f"--policy.transformer.{name} must be at least 1, got {value}")
        for name in ("dropout", "attention_dropout"):
            value = getattr(self, name)
            require(0 <= value < 1, f"--policy.transformer.{name} must be in [0, 1), got {value}")
        require(
            self.width >= 4 and self.width % 2 == 0 and self.width % self.n_heads == 0,
            "--policy.transformer.width must be even, at least 4 (it holds pairs of sines and cosines) and a "
            f"multiple of n_heads={self.n_heads}, got {self.width}",
        )


COUNTS = (
    "n_obs_steps",
    "horizon",
    "n_action_steps",
    "num_train_timesteps",
    "num_inference_steps",
    "noise_samples_per_frame",
)
"""Settings that are numbers of steps or samples."""


@PreTrainedConfig.register_subclass("diffusion_transformer")
@dataclass
class DiffusionTransformerConfig(DiffusionConfig):
    """LeRobot's diffusion policy with a choice of denoisers, averaged weights and data in memory.

    Everything that is not listed here means what it means for `--policy.type=diffusion`. The denoiser is

    - `mlp` (default): a residual MLP, cheap enough to train on a CPU, for low-dimensional observations;
    - `transformer`: DP-T of arXiv:2303.04137, trained with weight decay on its matrices and a warm-up;
    - `unet`: DP-C of the same paper, LeRobot's own U-Net (`down_dims`, `kernel_size`, ...).

    The optimizer's defaults are the MLP's; examples/presets/dp_t_pusht.yaml has those of the paper's DP-T.
    """

    # Steps of a predicted chunk, the first n_obs_steps - 1 of them in the past.
    horizon: int = 16
    # Steps executed per prediction.
    n_action_steps: int = 8
    # Frames at an episode's end that no training chunk starts from: horizon - n_action_steps - n_obs_steps + 1.
    drop_n_last_frames: int = 7
    # Width of the U-Net's stages; default: LeRobot's for denoiser=unet.
    down_dims: tuple[int, ...] = ()
    # (H, W) of image crops, random in training, from the center in evaluation; default: no cropping.
    crop_shape: tuple[int, int] | None = None

    # As LeRobot's, and observation.environment_state too, which LeRobot's diffusion policy does not normalize.
    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: {
            "VISUAL": NormalizationMode.MEAN_STD,
            "STATE": NormalizationMode.MIN_MAX,
            "ENV": NormalizationMode.MIN_MAX,
            "ACTION": NormalizationMode.MIN_MAX,
        }
    )
    # What the denoiser predicts: the clean chunk (sample), or the noise (epsilon).
    prediction_type: str = "sample"
    # Network that denoises: mlp, transformer or unet.
    denoiser: str = "mlp"
    mlp: MLPDenoiserConfig = field(default_factory=MLPDenoiserConfig)
    transformer: TransformerDenoiserConfig = field(default_factory=TransformerDenoiserConfig)
    # Average the weights (EMA, as in arXiv:2303.04137) and save the average as the policy's weights.
    ema: bool = True
    # Cut chunks from columns in memory; false: LeRobot's loader delivers them (needed for images).
    in_memory: bool = True
    # Noise levels drawn for every delivered frame, which is loaded and encoded once for all of them.
    noise_samples_per_frame: int = 4

    # Learning rate.
    optimizer_lr: float = 5e-4
    # AdamW's decay rates of the gradient's moments.
    optimizer_betas: tuple[float, float] = (0.9, 0.999)

    def __post_init__(self) -> None:
        require(
            self.denoiser in DENOISERS,
            f"--policy.denoiser must be one of {', '.join(DENOISERS)}, got '{self.denoiser}'",
        )
        require(
            self.prediction_type in ("sample", "epsilon"),
            f"--policy.prediction_type must be sample or epsilon, got '{self.prediction_type}'",
        )
        if not self.down_dims:
            self.down_dims = DiffusionConfig.down_dims if self.denoiser == "unet" else UNUSED_DOWN_DIMS
        require_at_least(self, 1, *COUNTS)
        require_at_least(self, 0, "drop_n_last_frames", "scheduler_warmup_steps")
        require_scheduler(self.scheduler_name)
        super().__post_init__()
        usable = self.horizon - self.n_obs_steps + 1
        require(
            self.n_action_steps <= usable,
            f"--policy.n_action_steps={self.n_action_steps} exceeds the {usable} steps that horizon "
            f"{self.horizon} leaves from the current step on with n_obs_steps {self.n_obs_steps}",
        )

    def get_optimizer_preset(self) -> AdamWConfig:  # type: ignore[override, unused-ignore]
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
            FlagError: if state or action are missing, or images are to be cut from memory.
            ValueError: if LeRobot refuses the features.
        """
        require(
            self.robot_state_feature is not None and self.action_feature is not None,
            "a diffusion policy needs the features observation.state and action, got "
            f"{list(self.input_features or {})} and {list(self.output_features or {})}",
        )
        super().validate_features()
        self._check_memory()

    def _check_memory(self) -> None:
        require(
            not (self.in_memory and self.image_features),
            f"--policy.in_memory=true holds no images, but the inputs are {list(self.image_features)}; "
            "pass --policy.in_memory=false to let LeRobot's loader deliver histories and chunks",
        )

    @property
    def action_dim(self) -> int:
        """Dimensions A of an action."""
        assert self.action_feature is not None  # validate_features
        return self.action_feature.shape[0]

    @property
    def chunk_delta_indices(self) -> list[int]:
        """Steps of a chunk relative to the current one."""
        return super().action_delta_indices

    @property
    def observation_delta_indices(self) -> list[int] | None:  # type: ignore[override, unused-ignore]
        """Observation steps requested from the loader; None: histories are cut from memory."""
        return None if self.in_memory else super().observation_delta_indices

    @property
    def action_delta_indices(self) -> list[int] | None:  # type: ignore[override, unused-ignore]
        """Action steps requested from the loader; None: chunks are cut from memory."""
        return None if self.in_memory else self.chunk_delta_indices
