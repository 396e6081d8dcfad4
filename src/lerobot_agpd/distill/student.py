"""The mixin that turns a LeRobot policy into a student of AGPD."""

import logging
from abc import abstractmethod
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from lerobot.configs import PolicyFeature
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.policies import PreTrainedPolicy
from lerobot.utils.constants import OBS_PREFIX
from lerobot.utils.feature_utils import dataset_to_policy_features
from lerobot.utils.random_utils import seeded_context
from torch import Tensor, nn

from lerobot_agpd.distill.adversary import Discriminator
from lerobot_agpd.distill.distillation import Distillation
from lerobot_agpd.distill.gradient_norms import GradientNorms
from lerobot_agpd.guidance.representation import StateRepresentation
from lerobot_agpd.replay.memory import delivers_single_frames
from lerobot_agpd.replay.normalisation import Statistics
from lerobot_agpd.weights import require_weights

logger = logging.getLogger(__name__)


class DistilledStudent(nn.Module):
    """Mixin: a policy trained by AGPD in LeRobot's own training loop.

    In eval mode it is the policy it is mixed into, and it loads without teacher, dataset or environment. A
    concrete class names this mixin before LeRobot's policy and implements `prior_chunk` and `embedding_dim`; one
    that denoises also implements `snapshot` and can then teach itself. Its configuration says which steps a chunk
    covers (`chunk_offsets`) and how many observations it looks at (`observation_history`).
    """

    config: Any
    can_teach_itself = False
    optional_weights: tuple[str, ...] = ("discriminator", "representation")
    """Parts that a checkpoint may lack: a student may be started with an adversary that it was saved without."""

    if TYPE_CHECKING:

        def predict_action_chunk(self, batch: dict[str, Tensor]) -> Tensor: ...  # noqa: D102

    @property
    @abstractmethod
    def embedding_dim(self) -> int:
        """Size E of the observation embedding that `prior_chunk` returns."""

    @abstractmethod
    def prior_chunk(self, rows: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
        """The student's chunk as the discriminator sees it, and an embedding of the observation.

        For a policy that predicts in one go this is the chunk that would be executed, and must not look at the
        recorded actions (ACT in training mode does). A policy that denoises returns the clean chunk that one
        denoising step estimates, so that nothing is backpropagated through its sampling.

        Returns:
            Chunks (B, S, A) from the current step on, with gradients, in the student's normalised space, and
            embeddings (B, E).
        """

    def snapshot(self) -> PreTrainedPolicy:
        """A frozen copy of the policy as it would be evaluated now, without what only trains it."""
        raise NotImplementedError(
            f"a '{self.config.type}' policy cannot teach itself: set --policy.teacher.path"
        )

    def init_distillation(
        self, dataset_meta: LeRobotDatasetMetadata | None, dataset_stats: Statistics | None
    ) -> None:
        """Add the discriminator and the representation; the rest is set up at the first training step."""
        config = self.config
        action_dim = config.action_feature.shape[0]
        self.discriminator: Discriminator | None = None
        if config.adversary.weight > 0:
            self.discriminator = Discriminator(
                config.future_steps, action_dim, self.embedding_dim, config.adversary
            )
        self.representation: StateRepresentation | None = None
        if config.representation.type == "state":
            n_steps = config.collect.n_action_steps or config.n_action_steps  # Distillation checks it
            self.representation = StateRepresentation(
                vector_dim(config), action_dim, n_steps, config.representation
            )
        self._demonstrations = (dataset_meta, dataset_stats)
        self._distillation: Distillation | None = None
        self._gradient_norms = GradientNorms(self.parameter_groups())

    # ---- LeRobot's training loop ----

    def forward(self, batch: dict[str, Any], **kwargs: Any) -> tuple[Tensor, dict[str, Any]]:
        """L_IL on a batch of T, plus AGPD's own losses in training mode.

        Batches of single frames (what `lerobot-train` delivers) are completed from memory; batches that hold
        chunks (B, S, A) are used as they are, without replay or adversary.
        """
        if not delivers_single_frames(batch):
            return super().forward(batch, **kwargs)
        distillation = self.distillation
        if not self.training:
            return super().forward(distillation.held_out_rows(batch), **kwargs)
        rows = distillation.training_rows(batch)
        loss, log = super().forward(rows, **kwargs)
        extra, extra_log = distillation.extra_losses(rows)
        return loss + extra, {
            "imitation_loss": loss.item(),
            **(log or {}),
            **extra_log,
            **self._gradient_norms.pop(),
        }

    def update(self) -> None:
        """Advance the alternation; LeRobot calls this after every optimizer step, on every process."""
        if hasattr(super(), "update"):
            super().update()  # type: ignore[misc]
        if self._distillation is not None:
            self._distillation.after_update()

    @property
    def distillation(self) -> Distillation:
        """What trains this student; built when first needed, from what the constructor was given."""
        if self._distillation is None:
            seed = torch.initial_seed() % 2**32
            with seeded_context(seed):  # loading a teacher draws numbers, which a resumed run must not notice
                self._distillation = Distillation(self, *self._demonstrations, seed=seed)
        return self._distillation

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Trainable parameters of student, discriminator and representation."""
        groups: dict[str, list[nn.Parameter]] = {"student": [], "discriminator": [], "representation": []}
        for name, parameter in self.named_parameters():
            owner = name.split(".", 1)[0]
            if parameter.requires_grad:
                groups[owner if owner in groups else "student"].append(parameter)
        return groups

    def get_optim_params(self) -> list[dict[str, Any]]:
        """The student's own groups, then one each for discriminator and representation if there are any."""
        groups = self.parameter_groups()
        own = {id(parameter) for parameter in groups["student"]}
        params = [
            {**group, "params": [p for p in group["params"] if id(p) in own]}
            for group in _as_groups(super().get_optim_params())  # type: ignore[misc]
        ]
        for name, lr in (
            ("discriminator", self.config.adversary.lr),
            ("representation", self.config.representation.lr),
        ):
            if groups[name]:
                params.append({"params": groups[name], "lr": lr})
        return params

    def _save_pretrained(self, save_directory: Path, state_dict: dict[str, Tensor] | None = None) -> None:
        super()._save_pretrained(save_directory, state_dict=state_dict)  # type: ignore[misc]
        if self._distillation is not None:
            self._distillation.save(save_directory)

    @classmethod
    def _load_as_safetensor(cls, model: Any, model_file: str, map_location: str, strict: bool) -> Any:
        require_weights(model, model_file, optional=cls.optional_weights)
        return super()._load_as_safetensor(model, model_file, map_location, strict)  # type: ignore[misc]

    # ---- features ----

    @staticmethod
    def demonstrated_features(dataset_meta: LeRobotDatasetMetadata) -> dict[str, PolicyFeature]:
        """Observation features that the demonstrations hold."""
        features = dataset_to_policy_features(dataset_meta.features)
        return {key: feature for key, feature in features.items() if key.startswith(OBS_PREFIX)}


def vector_dim(config: Any) -> int:
    """Size D of all low-dimensional observations side by side.

    Raises:
        ValueError: if there are none.
    """
    vectors = [ft.shape[0] for key, ft in config.input_features.items() if key not in config.image_features]
    if not vectors:
        raise ValueError(
            "--policy.representation.type=state predicts low-dimensional observations, but the inputs are "
            f"{list(config.input_features)}; use --policy.representation.type=action"
        )
    return sum(vectors)


def _as_groups(params: Iterable[Any]) -> list[dict[str, Any]]:
    """Optimizer parameters as a list of groups."""
    entries = list(params)
    return entries if entries and isinstance(entries[0], dict) else [{"params": entries}]
