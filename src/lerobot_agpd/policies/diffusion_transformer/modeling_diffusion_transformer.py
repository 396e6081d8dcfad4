"""LeRobot's diffusion policy with another denoiser, averaged weights and rows cut from memory."""

import logging
from pathlib import Path
from typing import Any

import torch
from diffusers.training_utils import EMAModel
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.policies.diffusion.modeling_diffusion import DiffusionModel, DiffusionPolicy
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from lerobot_agpd.policies.diffusion_transformer.configuration_diffusion_transformer import (
    DiffusionTransformerConfig,
)
from lerobot_agpd.policies.diffusion_transformer.denoisers import MLPDenoiser
from lerobot_agpd.replay.memory import FrameMemory, delivers_single_frames, gather_rows
from lerobot_agpd.replay.normalisation import Statistics
from lerobot_agpd.run import this_run
from lerobot_agpd.weights import require_weights

logger = logging.getLogger(__name__)

RAW_WEIGHTS = "raw_weights.safetensors"
"""The weights the optimizer works on, beside the averaged ones in model.safetensors; only resuming reads them."""


class DiffusionTransformerPolicy(DiffusionPolicy):
    """Diffusion policy (arXiv:2303.04137) whose denoiser is a plug-in.

    The averaged (EMA) weights are the policy's weights everywhere but in training mode: `eval()` swaps them
    in, `train()` swaps them out, and `save_pretrained` writes them to model.safetensors, so that evaluation,
    teachers and the Hub see them under LeRobot's own parameter names.
    """

    config_class = DiffusionTransformerConfig
    name = "diffusion_transformer"

    def __init__(
        self,
        config: DiffusionTransformerConfig,
        dataset_stats: Statistics | None = None,
        dataset_meta: LeRobotDatasetMetadata | None = None,
        **kwargs: Any,
    ):
        """Build the policy; with `dataset_meta` its frames are loaded into memory at the first training step."""
        super().__init__(config, **kwargs)
        self.config: DiffusionTransformerConfig = config
        denoiser: Any = make_denoiser(config, self.diffusion)
        if config.compile_model:
            denoiser = torch.compile(denoiser, mode=config.compile_mode)
        self.diffusion.unet = denoiser
        self._dataset = (dataset_meta, dataset_stats)
        self._memory: FrameMemory | None = None
        self._ema: EMAModel | None = None
        self._ema_is_active = False

    # ---- training ----

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, None]:
        """Noise prediction loss on a batch of single frames (`index`) or of LeRobot's own chunks."""
        if delivers_single_frames(batch):
            batch = self._gather(batch)
        if self.training and self.config.ema.enable and self._ema is None:
            self._ema = self._make_ema()  # before the first step: resuming exchanges the weights here
        if self.training and self.config.noise_samples_per_frame > 1:
            repeats = self.config.noise_samples_per_frame
            batch = {k: v.repeat_interleave(repeats, 0) for k, v in batch.items() if isinstance(v, Tensor)}
        return super().forward(batch)

    def _gather(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        if self._memory is None:
            self._memory = FrameMemory(self.config, *self._dataset)
        self._memory.observe(batch)
        offsets = torch.as_tensor(self.config.chunk_offsets)
        return gather_rows(
            self._memory.normalised, batch["index"], self.config, offsets, self.config.n_obs_steps
        )

    def update(self) -> None:
        """Average the weights; called by LeRobot's loop after every optimizer step."""
        if self._ema is not None:
            self._ema.step(self.diffusion.parameters())

    def train(self, mode: bool = True) -> "DiffusionTransformerPolicy":
        """Switch mode; evaluation mode runs on the averaged weights."""
        self._activate_ema(not mode)
        return super().train(mode)

    # ---- averaged weights ----

    def _make_ema(self) -> EMAModel:
        ema = EMAModel(
            self.diffusion.parameters(),
            decay=self.config.ema.max_decay,
            use_ema_warmup=True,
            power=self.config.ema.power,
            foreach=True,
        )
        checkpoint = self.config.pretrained_path
        if checkpoint and this_run().resume:
            ema.optimization_step = self._load_raw_weights(Path(checkpoint))
        return ema

    def _load_raw_weights(self, checkpoint: Path) -> int:
        path = checkpoint / RAW_WEIGHTS
        if not path.is_file():
            raise FileNotFoundError(
                f"{path} is missing: this checkpoint cannot be resumed with averaged weights. Start a new run "
                "from it with --policy.path, or pass --policy.ema.enable=false"
            )
        raw = load_file(path)
        steps = int(raw.pop("ema_steps"))
        self.diffusion.load_state_dict(raw)
        return steps

    def _activate_ema(self, active: bool) -> None:
        ema = getattr(self, "_ema", None)
        if ema is None or active == self._ema_is_active:
            return
        if active:
            ema.store(self.diffusion.parameters())
            ema.copy_to(self.diffusion.parameters())
        else:
            ema.restore(self.diffusion.parameters())
        self._ema_is_active = active

    @classmethod
    def _load_as_safetensor(cls, model: Any, model_file: str, map_location: str, strict: bool) -> Any:
        require_weights(model, model_file)
        return super()._load_as_safetensor(model, model_file, map_location, strict)

    def _save_pretrained(self, save_directory: Path, state_dict: dict[str, Tensor] | None = None) -> None:
        was_active = self._ema_is_active
        if self._ema is not None:
            self._activate_ema(False)
            raw = {key: value.contiguous().cpu() for key, value in self.diffusion.state_dict().items()}
            raw["ema_steps"] = torch.tensor(self._ema.optimization_step)
            save_file(raw, save_directory / RAW_WEIGHTS)
        self._activate_ema(True)
        super()._save_pretrained(save_directory, state_dict=state_dict)
        self._activate_ema(was_active)


def make_denoiser(config: DiffusionTransformerConfig, model: DiffusionModel) -> MLPDenoiser:
    """The denoiser that `config` names, sized for the condition of LeRobot's diffusion model."""
    if config.robot_state_feature is None or config.action_feature is None:
        raise ValueError(
            "a diffusion policy needs the features observation.state and action, got "
            f"{list(config.input_features or {})} and {list(config.output_features or {})}"
        )
    per_step = config.robot_state_feature.shape[0]
    if config.env_state_feature is not None:
        per_step += config.env_state_feature.shape[0]
    if config.image_features:
        encoder: Any = model.rgb_encoder
        if isinstance(encoder, nn.ModuleList):
            encoder = encoder[0]
        per_step += encoder.feature_dim * len(config.image_features)
    return MLPDenoiser(
        horizon=config.horizon,
        action_dim=config.action_feature.shape[0],
        cond_dim=per_step * config.n_obs_steps,
        width=config.mlp.width,
        n_blocks=config.mlp.n_blocks,
        time_embed_dim=config.mlp.time_embed_dim,
    )
