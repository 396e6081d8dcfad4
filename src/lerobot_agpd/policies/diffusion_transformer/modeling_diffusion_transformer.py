"""LeRobot's diffusion policy with an exchangeable denoiser, averaged weights and chunks cut from memory."""

from pathlib import Path
from typing import Any, Self

from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.policies import PreTrainedPolicy
from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig
from lerobot.policies.diffusion.modeling_diffusion import DiffusionModel, DiffusionPolicy
from lerobot.utils.constants import ACTION
from torch import Tensor

from lerobot_agpd.cards.model_card import ModelFacts
from lerobot_agpd.flag_checks import require
from lerobot_agpd.policies.carded import CardedPolicy
from lerobot_agpd.policies.diffusion_transformer.averaged_weights import AveragedWeights
from lerobot_agpd.policies.diffusion_transformer.configuration_diffusion_transformer import (
    DiffusionTransformerConfig,
)
from lerobot_agpd.policies.diffusion_transformer.model import DenoisingModel
from lerobot_agpd.policies.diffusion_transformer.transformer import weight_decay_groups
from lerobot_agpd.policies.fused_groups import ParameterGroup, fused_groups
from lerobot_agpd.replay.demonstrations import DemonstrationFrames, delivers_single_frames
from lerobot_agpd.replay.normalization import Statistics
from lerobot_agpd.replay.served_frames import serve_from_memory
from lerobot_agpd.run import RunInfo
from lerobot_agpd.weights import acting_parameters, is_main_process, require_weights

SUMMARY = """\
A diffusion policy for [LeRobot](https://github.com/huggingface/lerobot), of a type that the plugin lerobot_policy_agpd
adds. It can teach a faster policy there."""
"""First paragraph of the model card."""


class DiffusionTransformerPolicy(CardedPolicy, DiffusionPolicy):
    """Diffusion policy (arXiv:2303.04137) with an MLP, a transformer or LeRobot's U-Net as its denoiser.

    The averaged (EMA) weights are the policy's weights everywhere but in training mode: `eval()` swaps them
    in, `train()` swaps them out, and `save_pretrained` writes them to model.safetensors, so that evaluation,
    teachers and the Hub see them under LeRobot's own parameter names.
    """

    config_class: type[DiffusionConfig] = DiffusionTransformerConfig
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
        self.run = run or RunInfo.of(config) or RunInfo()
        for dataset in self.run.datasets:
            serve_from_memory(dataset)
        if config.ema:
            _check_averaging(self.run)
        self.diffusion = self.model_class(config)
        self.reset()
        self._dataset = (dataset_meta, dataset_stats)
        self._demonstrations: DemonstrationFrames | None = None
        self._average: AveragedWeights | None = None

    def get_optim_params(self) -> list[ParameterGroup]:  # type: ignore[override, unused-ignore]
        """Parameters for the optimizer; with a transformer, weight decay is for its matrices alone."""
        if self.config.denoiser == "transformer":
            return fused_groups(weight_decay_groups(self.diffusion))
        return fused_groups(self.diffusion.parameters())

    # ---- training ----

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, None]:
        """Denoising loss on a batch of single frames (with their `index`) or of LeRobot's own chunks."""
        if delivers_single_frames(batch):
            batch = self._gather(batch)
        if self.training and self.config.ema and self._average is None:
            self._average = (
                self._start_average()
            )  # before the first step: resuming exchanges the weights here
        if self.training and self.config.noise_samples_per_frame > 1:
            repeats = self.config.noise_samples_per_frame
            targets = {k: batch[k].repeat_interleave(repeats, 0) for k in (ACTION, "action_is_pad")}
            batch = {**batch, **targets}  # the model encodes an observation once for all its targets
        return super().forward(batch)

    def _gather(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """Histories and chunks around the frames of a batch."""
        if self._demonstrations is None:
            self._demonstrations = DemonstrationFrames(self.config, *self._dataset)
        self._demonstrations.observe(batch)
        return self._demonstrations.gather_batch(
            batch["index"], self.config.chunk_delta_indices, self.config.n_obs_steps
        )

    def update(self) -> None:
        """Average the weights; called by LeRobot's loop after every optimizer step."""
        if self._average is not None:
            self._average.step()

    def train(self, mode: bool = True) -> Self:
        """Switch mode; evaluation mode runs on the averaged weights."""
        if self._average is not None:
            self._average.activate(not mode)
        return super().train(mode)

    def _start_average(self) -> AveragedWeights:
        average = AveragedWeights(self.diffusion)
        if self.config.pretrained_path and self.run.resume:
            average.load_raw(Path(self.config.pretrained_path))
        return average

    # ---- checkpoints ----

    def model_facts(self) -> ModelFacts | None:
        """What the model card says of the run; None outside of one."""
        dataset = self._dataset[0]
        if dataset is None:
            return None
        config = self.config
        facts = {
            "demonstrations": f"`{dataset.repo_id}`, {dataset.fps} fps",
            "denoiser": config.denoiser,
            "denoising steps": f"{config.num_inference_steps or config.num_train_timesteps}, {config.noise_scheduler_type}",
            "parameters": f"{acting_parameters(self) / 1e6:.2f} M",
            "chunk": f"{config.horizon} steps, {config.n_action_steps} executed",
            "training steps": str(self.run.steps or "unknown"),
        }
        return ModelFacts(SUMMARY, facts, dataset.repo_id, env=self.run.env, resumed=self.run.resume)

    @classmethod
    def _load_as_safetensor[T: PreTrainedPolicy](
        cls, model: T, model_file: str, map_location: str, strict: bool
    ) -> T:
        require_weights(model, model_file, optional=cls.optional_weights)
        return super()._load_as_safetensor(model, model_file, map_location, strict)

    def _save_pretrained(self, save_directory: Path, **kwargs: Any) -> None:  # type: ignore[override, unused-ignore]
        """Save the averaged weights, and the raw ones beside them.

        LeRobot 0.6.1 calls this on the main process with `state_dict`, which is None unless the run is sharded;
        later versions call it on every process without.
        """
        if self._average is None:
            super()._save_pretrained(save_directory, **kwargs)
            return
        if is_main_process():
            self._average.save_raw(save_directory)
        with self._average.activated(True):
            if kwargs.get("state_dict") is not None:  # collected by the caller: raw weights
                kwargs["state_dict"] = {**kwargs["state_dict"], **self.state_dict()}
            super()._save_pretrained(save_directory, **kwargs)


def _check_averaging(run: RunInfo) -> None:
    """Refuse runs in which the weights cannot be averaged.

    Raises:
        FlagError: if LeRobot averages them too, or no process holds all of them.
    """
    require(
        not run.lerobot_ema,
        "--policy.ema=true and --ema.enable=true both average the weights: pass --ema.enable=false (this policy "
        "evaluates and saves its own average), or --policy.ema=false",
    )
    require(
        not run.sharded,
        "--policy.ema=true needs whole parameters on every process, but the run shards them (FSDP, "
        "--parallelism.*): train with DDP, or pass --policy.ema=false",
    )
