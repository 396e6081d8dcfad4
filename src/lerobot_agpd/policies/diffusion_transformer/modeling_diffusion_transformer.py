"""LeRobot's diffusion policy with another denoiser, averaged weights and rows cut from memory."""

import logging
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import torch
from diffusers.training_utils import EMAModel
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.policies import PreTrainedPolicy
from lerobot.policies.diffusion.modeling_diffusion import DiffusionModel, DiffusionPolicy
from lerobot.utils.constants import ACTION
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from lerobot_agpd.policies.diffusion_transformer.configuration_diffusion_transformer import (
    DiffusionTransformerConfig,
)
from lerobot_agpd.policies.diffusion_transformer.model import DenoisingModel
from lerobot_agpd.policies.diffusion_transformer.transformer import weight_decay_groups
from lerobot_agpd.replay.demonstrations import DemonstrationFrames, delivers_single_frames
from lerobot_agpd.replay.normalization import Statistics
from lerobot_agpd.run import RunInfo
from lerobot_agpd.weights import require_weights

logger = logging.getLogger(__name__)

RAW_WEIGHTS = "raw_weights.safetensors"
"""The weights the optimizer works on, beside the averaged ones in model.safetensors; only resuming reads them."""


class DiffusionTransformerPolicy(DiffusionPolicy):
    """Diffusion policy (arXiv:2303.04137) with an MLP, a transformer or LeRobot's U-Net as its denoiser.

    The averaged (EMA) weights are the policy's weights everywhere but in training mode: `eval()` swaps them
    in, `train()` swaps them out, and `save_pretrained` writes them to model.safetensors, so that evaluation,
    teachers and the Hub see them under LeRobot's own parameter names.
    """

    config_class = DiffusionTransformerConfig
    name = "diffusion_transformer"
    model_class: type[DiffusionModel] = DenoisingModel
    optional_weights: tuple[str, ...] = ()

    def __init__(
        self,
        config: DiffusionTransformerConfig,
        dataset_stats: Statistics | None = None,
        dataset_meta: LeRobotDatasetMetadata | None = None,
        run: RunInfo | None = None,
        **kwargs: Any,
    ):
        """Build the policy; with `dataset_meta` its frames are loaded into memory at the first training step."""
        # Not DiffusionPolicy's constructor: it would build a second model, only to be thrown away.
        PreTrainedPolicy.__init__(self, config)
        config.validate_features()
        self.config: DiffusionTransformerConfig = config
        self.run = run or RunInfo.of(config)
        self.diffusion = self.model_class(config)
        self.reset()
        self._dataset = (dataset_meta, dataset_stats)
        self._memory: DemonstrationFrames | None = None
        self._ema: EMAModel | None = None
        self._ema_is_active = False

    def get_optim_params(self) -> Iterable[Tensor] | list[dict[str, Any]]:
        """Parameters for the optimizer; with a transformer, weight decay is for its matrices alone."""
        if self.config.denoiser == "transformer":
            return weight_decay_groups(self.diffusion)
        return self.diffusion.parameters()

    # ---- training ----

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict[str, Any] | None]:
        """Noise prediction loss on a batch of single frames (`index`) or of LeRobot's own chunks."""
        if delivers_single_frames(batch):
            batch = self._gather(batch)
        if self.training and self.config.ema.enable and self._ema is None:
            self._ema = self._make_ema()  # before the first step: resuming exchanges the weights here
        if self.training and self.config.noise_samples_per_frame > 1:
            repeats = self.config.noise_samples_per_frame
            targets = {k: batch[k].repeat_interleave(repeats, 0) for k in (ACTION, "action_is_pad")}
            batch = {**batch, **targets}  # the model encodes an observation once for all its targets
        return super().forward(batch)

    def _gather(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        if self._memory is None:
            self._memory = DemonstrationFrames(self.config, *self._dataset)
        self._memory.observe(batch)
        return self._memory.gather_batch(
            batch["index"], self.config.chunk_delta_indices, self.config.n_obs_steps
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
        if os.environ.get("ACCELERATE_USE_FSDP", "false").lower() == "true":
            raise RuntimeError(
                "averaged weights need whole parameters on every process, but the run shards them (FSDP): train "
                "with DDP, or pass --policy.ema.enable=false"
            )
        if any(isinstance(module, nn.modules.batchnorm._BatchNorm) for module in self.diffusion.modules()):
            logger.warning(
                "batch normalization's running statistics are not averaged with the weights; consider "
                "--policy.use_group_norm=true --policy.pretrained_backbone_weights=null"
            )
        ema = EMAModel(
            self.diffusion.parameters(),
            decay=self.config.ema.max_decay,
            use_ema_warmup=True,
            power=self.config.ema.power,
            foreach=True,
        )
        checkpoint = self.config.pretrained_path
        if checkpoint and self.run is not None and self.run.resume:
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
        require_weights(model, model_file, optional=cls.optional_weights)
        return super()._load_as_safetensor(model, model_file, map_location, strict)

    def _save_pretrained(self, save_directory: Path, state_dict: dict[str, Tensor] | None = None) -> None:
        was_active = self._ema_is_active
        if self._ema is not None:
            self._activate_ema(False)
            raw = {key: value.contiguous().cpu() for key, value in self.diffusion.state_dict().items()}
            raw["ema_steps"] = torch.tensor(self._ema.optimization_step)
            save_file(raw, save_directory / RAW_WEIGHTS)
        self._activate_ema(True)
        if self._ema is not None and state_dict is not None:  # gathered by the caller: raw weights
            state_dict = {**state_dict, **self.state_dict()}
        super()._save_pretrained(save_directory, state_dict=state_dict)
        self._activate_ema(was_active)
