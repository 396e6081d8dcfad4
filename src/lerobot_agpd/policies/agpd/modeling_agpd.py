"""The ACT student of AGPD."""

import logging
from collections.abc import Mapping
from typing import Any

import torch
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.utils.constants import OBS_IMAGES
from torch import Tensor, nn

from lerobot_agpd.guidance.visual import pooled
from lerobot_agpd.policies.agpd.configuration_agpd import AGPDConfig
from lerobot_agpd.policies.distilled import DistilledPolicy
from lerobot_agpd.policies.encoders import GroupNormResNet, SmallEncoder
from lerobot_agpd.replay.normalization import Statistics
from lerobot_agpd.run import RunInfo
from lerobot_agpd.student import PriorChunk

logger = logging.getLogger(__name__)


class AGPDPolicy(DistilledPolicy, ACTPolicy):  # type: ignore[misc]
    """ACT (arXiv:2304.13705) distilled from a diffusion policy; in eval mode it is LeRobot's ACT.

    With `encoder` other than resnet that ACT has another backbone, which LeRobot's own does not know.
    """

    config: AGPDConfig
    config_class: type[ACTConfig] = AGPDConfig
    name = "agpd"

    def __init__(
        self,
        config: AGPDConfig,
        dataset_stats: Statistics | None = None,
        dataset_meta: LeRobotDatasetMetadata | None = None,
        run: RunInfo | None = None,
        **kwargs: Any,
    ):
        """Build ACT and the adversary; without `dataset_meta` the policy can be evaluated but not trained."""
        config.select_inputs()
        super().__init__(config, **kwargs)
        if config.image_features:
            self._choose_encoder(is_new=dataset_meta is not None and not config.pretrained_path)
        self.init_distillation(dataset_meta, dataset_stats, run)

    def _choose_encoder(self, is_new: bool) -> None:
        """Exchange ACT's backbone for the encoder of the configuration."""
        config = self.config
        if config.encoder == "resnet":
            if is_new and config.pretrained_backbone_weights is None:
                logger.warning(
                    "--policy.pretrained_backbone_weights=null leaves the batch norm of --policy.encoder=resnet at the "
                    "identity: the network is not normalized; pass --policy.encoder=resnet_group_norm, or small on a CPU"
                )
            return
        encoder: SmallEncoder | GroupNormResNet
        if config.encoder == "small":
            encoder = SmallEncoder(config.encoder_shift)
        else:
            dilated = bool(config.replace_final_stride_with_dilation)
            encoder = GroupNormResNet(config.vision_backbone, dilated)
        self.model.backbone = encoder
        self.model.encoder_img_feat_input_proj = nn.Conv2d(
            encoder.out_channels, config.dim_model, kernel_size=1
        )

    @property
    def embedding_dim(self) -> int:
        """Width of ACT's transformer."""
        return self.config.dim_model

    def prior_chunk(self, batch: Mapping[str, Tensor]) -> PriorChunk:
        """ACT's chunk with its latent at the prior's mean, as executed, and its mean encoder token.

        In training mode ACT decodes from a latent that has seen the recorded actions. Here the actions are left
        out and the network runs in eval mode (no dropout either), with gradients.
        """
        inputs: dict[str, Any] = {key: batch[key] for key in self.config.input_features or {}}
        if self.config.image_features:
            inputs[OBS_IMAGES] = [batch[key] for key in self.config.image_features]
        tokens: list[Tensor] = []  # (n_tokens, B, dim_model)
        hook = self.model.encoder.register_forward_hook(lambda module, args, output: tokens.append(output))
        was_training = self.model.training
        self.model.eval()
        try:
            chunk = self.model(inputs)[0]
        finally:
            self.model.train(was_training)
            hook.remove()
        return PriorChunk(chunk, tokens[0].mean(dim=0))

    def image_tokens(self, images: Mapping[str, Tensor]) -> Tensor:
        """The feature maps of ACT's backbone for the cameras' normalized images (B, C, H, W), one token per place."""
        maps = (self.model.backbone(images[key])["feature_map"] for key in self.config.image_features)
        return torch.cat([pooled(each) for each in maps], dim=1)
