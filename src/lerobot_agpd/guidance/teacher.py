"""A frozen LeRobot diffusion policy as a teacher: its own processors, batched chunks, guided or not."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from diffusers.schedulers.scheduling_ddim import DDIMScheduler
from diffusers.schedulers.scheduling_ddpm import DDPMScheduler
from lerobot.configs import PolicyFeature, PreTrainedConfig
from lerobot.lerobot_types import TransitionKey
from lerobot.policies import get_policy_class, make_pre_post_processors
from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy
from lerobot.processor import NormalizerProcessorStep, PolicyAction, PolicyProcessorPipeline
from lerobot.utils.constants import ACTION, OBS_IMAGES
from torch import Tensor

from lerobot_agpd.guidance.config import TeacherConfig
from lerobot_agpd.guidance.guide import Guide, guided

SCHEDULER_CLASSES = {"DDPM": DDPMScheduler, "DDIM": DDIMScheduler}

Features = Mapping[str, PolicyFeature]


class DiffusionTeacher:
    """Samples chunks from a frozen diffusion policy; keeps no state between calls.

    It is deliberately not an nn.Module: as an attribute of a student it must not enter the student's
    state_dict, DDP or `.to()`.
    """

    def __init__(
        self,
        policy: DiffusionPolicy,
        preprocessor: PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
        postprocessor: PolicyProcessorPipeline[PolicyAction, PolicyAction],
    ):
        """Freeze the policy and keep its processors."""
        self.policy = policy.eval().requires_grad_(False)
        self._preprocessor = preprocessor
        self._postprocessor = postprocessor
        self._normaliser = next(
            step for step in preprocessor.steps if isinstance(step, NormalizerProcessorStep)
        )

    @property
    def n_obs_steps(self) -> int:
        """Length of the observation history it needs."""
        return self.policy.config.n_obs_steps

    @property
    def start(self) -> int:
        """Index of the current step in its internal chunk."""
        return self.n_obs_steps - 1

    @property
    def n_chunk_steps(self) -> int:
        """Steps of a chunk from the current one on."""
        return self.policy.config.horizon - self.start

    @property
    def n_action_steps(self) -> int:
        """Steps it executes per prediction by itself."""
        return self.policy.config.n_action_steps

    @property
    def input_features(self) -> Features:
        """Observations it needs."""
        return self.policy.config.input_features

    @property
    def action_feature(self) -> PolicyFeature:
        """Its action space."""
        return self.policy.config.output_features[ACTION]

    def to_units(self, actions_raw: Tensor) -> Tensor:
        """Raw actions (..., A) in the teacher's normalised space."""
        return self._normaliser({TransitionKey.ACTION: actions_raw})[TransitionKey.ACTION]

    def to_raw(self, actions: Tensor) -> Tensor:
        """Actions (..., A) of the teacher's normalised space in the environment's units."""
        return self._postprocessor(actions).to(actions.device)

    @torch.no_grad()
    def sample(
        self,
        history: Mapping[str, Tensor],
        guide: Guide | None = None,
        generator: torch.Generator | None = None,
    ) -> Tensor:
        """Predict chunks.

        Args:
            history: raw observations per feature, (B, n_obs_steps, ...), images as floats in [0, 1].
            guide: pulls rows toward another chunk; rows with scale 0 equal unguided ones bit for bit.
            generator: source of the sampling noise.

        Returns:
            (B, n_chunk_steps, A) raw actions from the current step on.
        """
        batch = self._prepare(history)
        model = self.policy.diffusion
        condition = model._prepare_global_conditioning(batch)  # (B, C)
        with guided(model, guide):
            chunk = model.conditional_sample(len(condition), global_cond=condition, generator=generator)
        return self.to_raw(chunk[:, self.start :])

    def _prepare(self, history: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Run the teacher's preprocessor on every step of the history and stack its cameras."""
        missing = [key for key in self.input_features if key not in history]
        if missing:
            raise KeyError(f"the teacher needs {missing}; it was given {sorted(history)}")
        n_obs = self.n_obs_steps
        batch_size = len(next(iter(history.values())))
        flat = {key: history[key].flatten(0, 1) for key in self.input_features}
        processed = self._preprocessor(flat)
        batch = {key: processed[key].unflatten(0, (batch_size, n_obs)) for key in self.input_features}
        cameras = list(self.policy.config.image_features)
        if cameras:
            batch[OBS_IMAGES] = torch.stack([batch[key] for key in cameras], dim=-4)
        return batch


def load_teacher(config: TeacherConfig, device: str) -> DiffusionTeacher:
    """Load the teacher that `--policy.teacher.path` names.

    Raises:
        ValueError: if no path is given or the checkpoint is not a diffusion policy.
        FileNotFoundError: if there is no policy at the path.
    """
    if not config.path:
        raise ValueError(
            "--policy.teacher.path is not set: AGPD distils a diffusion policy, so name a checkpoint folder or a "
            "Hub repository. To clone the demonstrations alone, pass --policy.collect.every=0 "
            "--policy.adversary.weight=0"
        )
    try:
        policy_config = PreTrainedConfig.from_pretrained(config.path)
    except Exception as error:
        raise FileNotFoundError(
            f"--policy.teacher.path='{config.path}' is neither a folder with a policy's config.json nor a Hub "
            f"repository that can be reached ({error})"
        ) from error
    policy_class = get_policy_class(policy_config.type)
    if not issubclass(policy_class, DiffusionPolicy):
        raise ValueError(
            f"--policy.teacher.path='{config.path}' is a '{policy_config.type}' policy; guidance needs one that "
            "denoises (type 'diffusion' or a subclass of it, such as 'diffusion_transformer')"
        )
    policy_config.device = device
    policy_config.pretrained_path = Path(config.path)
    policy = policy_class.from_pretrained(config.path, config=policy_config)
    _set_sampler(policy, config)
    preprocessor, postprocessor = make_pre_post_processors(
        policy_config,
        pretrained_path=config.path,
        preprocessor_overrides={"device_processor": {"device": device}},
    )
    return DiffusionTeacher(policy, preprocessor, postprocessor)


def _set_sampler(policy: DiffusionPolicy, config: TeacherConfig) -> None:
    model = policy.diffusion
    if config.noise_scheduler is not None:
        scheduler_class = SCHEDULER_CLASSES[config.noise_scheduler]
        model.noise_scheduler = scheduler_class.from_config(model.noise_scheduler.config)
    if config.num_inference_steps is not None:
        limit = model.noise_scheduler.config.num_train_timesteps
        if config.num_inference_steps > limit:
            raise ValueError(
                f"--policy.teacher.num_inference_steps={config.num_inference_steps} exceeds the {limit} "
                "diffusion steps the teacher was trained with"
            )
        model.num_inference_steps = config.num_inference_steps


def check_teacher_fits(teacher: DiffusionTeacher, available: Features, action: PolicyFeature) -> None:
    """Refuse a teacher that the observations or the action space at hand cannot serve.

    Args:
        teacher: the teacher.
        available: observation features that the demonstrations hold (and the environment delivers).
        action: the student's action feature.

    Raises:
        ValueError: listing both sides.
    """
    needed = {key: tuple(ft.shape) for key, ft in teacher.input_features.items()}
    given = {key: tuple(ft.shape) for key, ft in available.items()}
    wrong = {key: shape for key, shape in needed.items() if given.get(key) != shape}
    if wrong:
        raise ValueError(
            f"the teacher (--policy.teacher.path) needs the observations {needed}, the demonstrations hold "
            f"{given}; they differ in {sorted(wrong)}"
        )
    if tuple(teacher.action_feature.shape) != tuple(action.shape):
        raise ValueError(
            f"the teacher's actions have shape {tuple(teacher.action_feature.shape)}, the demonstrations' "
            f"{tuple(action.shape)}: choose a teacher of the same action space (--policy.teacher.path)"
        )
