"""The hooks of LeRobot's training loop for every student of AGPD."""

import logging
import math
import weakref
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import torch
from accelerate import PartialState
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.utils.random_utils import seeded_context
from torch import Tensor, nn

from lerobot_agpd.adversary import Discriminator
from lerobot_agpd.agpd import AGPD
from lerobot_agpd.build import build_parts
from lerobot_agpd.cards.distillation import distillation_facts
from lerobot_agpd.cards.model_card import ModelFacts
from lerobot_agpd.continuation import how_to_continue
from lerobot_agpd.guidance.representation import LR
from lerobot_agpd.interrupts import InterruptMessage
from lerobot_agpd.policies.carded import CardedPolicy
from lerobot_agpd.policies.fused_groups import ParameterGroup, fused_groups
from lerobot_agpd.policies.gradient_norms import GradientNorms
from lerobot_agpd.policies.representations import make_representation
from lerobot_agpd.replay.demonstrations import delivers_single_frames
from lerobot_agpd.replay.export import merge, upload
from lerobot_agpd.replay.normalization import Statistics
from lerobot_agpd.replay.served_frames import serve_from_memory
from lerobot_agpd.run import RunInfo
from lerobot_agpd.student import Student
from lerobot_agpd.weights import acting_parameters, not_finite_weight, require_weights

logger = logging.getLogger(__name__)

LOSSES = ("imitation_loss", "discriminator_loss", "adversarial_loss", "representation_loss")

REMEDY = (
    "nothing of it is saved. Start again from the last checkpoint with a lower learning rate (--policy.optimizer_lr, "
    "--policy.adversary.lr)"
)


class DistilledPolicy(CardedPolicy, Student):
    """Mixin: a policy trained by AGPD in LeRobot's own training loop.

    In eval mode it is the policy it is mixed into, and it loads without teacher, dataset or environment. A
    concrete class names this mixin before LeRobot's policy and implements the abstract parts of `Student`.
    """

    discriminator: Discriminator | None
    optional_weights: tuple[str, ...] = ("discriminator", "representation")
    """Parts that a checkpoint may lack: a student may be started with an adversary that it was saved without."""

    def init_distillation(
        self,
        dataset_meta: LeRobotDatasetMetadata | None,
        dataset_stats: Statistics | None,
        run: RunInfo | None,
    ) -> None:
        """Add discriminator and representation; in a training run, load and check everything else now.

        Args:
            dataset_meta: metadata of the demonstrations; without it the policy can be evaluated but not trained.
            dataset_stats: their statistics.
            run: the training run; default: the one that is building this policy. Without any, what trains the policy is
                built at the first training step.
        """
        config = self.config
        assert config.action_feature is not None
        action_dim = config.action_feature.shape[0]
        self.discriminator = None
        if config.adversary.weight > 0:
            self.discriminator = Discriminator(config.future_steps, action_dim, self.embedding_dim)
        self.representation, self.visual_encoder = make_representation(
            self, is_trained=dataset_meta is not None
        )
        self._gradient_norms = GradientNorms(self.parameter_groups())
        self._last_norms: dict[str, float] = {}
        is_lerobots, run = run is None, run or RunInfo.of(config)
        for dataset in run.datasets if run else ():
            serve_from_memory(dataset)
        self._training_data = (dataset_meta, dataset_stats, run or RunInfo())
        self._agpd: AGPD | None = None
        if run is not None and dataset_meta is not None:
            agpd = self.agpd  # wrong input ends the run here, before training starts
            if is_lerobots:
                self._watch_interruptions(agpd)

    @property
    def agpd(self) -> AGPD:
        """What trains this student."""
        if self._agpd is None:
            seed = torch.initial_seed() % 2**32
            with seeded_context(seed):  # loading a teacher draws numbers, which a resumed run must not notice
                self._agpd = AGPD(self, build_parts(self, *self._training_data, seed=seed))
        return self._agpd

    def _watch_interruptions(self, agpd: AGPD) -> None:
        """Let Ctrl-C and SIGTERM say how the run goes on, until this policy is no longer used."""
        if agpd.journal is None or agpd.run.output_dir is None:
            return
        text = partial(how_to_continue, agpd.run.output_dir, agpd.journal.root)
        message = InterruptMessage(text if PartialState().is_main_process else None)
        message.watch()
        weakref.finalize(self, message.restore)

    # ---- LeRobot's training loop ----

    def forward(self, batch: dict[str, Any], **kwargs: Any) -> tuple[Tensor, dict[str, Any]]:
        """L_IL on a batch of T, plus AGPD's own losses in training mode.

        Batches of single frames (what `lerobot-train` delivers) are completed from memory; batches that hold
        chunks (B, S, A) are used as they are, without replay or adversary.
        """
        if not delivers_single_frames(batch):
            return super().forward(batch, **kwargs)
        agpd = self.agpd
        if not self.training:
            return super().forward(agpd.replay.eval_batch(batch), **kwargs)
        batch = agpd.train_batch(batch)
        loss, log = super().forward(batch, **kwargs)
        reference = agpd.adversary_batch(batch)
        prior = self.prior_chunk(reference.batch) if reference and len(reference.chunk) else None
        losses = agpd.losses(batch, reference, prior, self.discriminator)
        log = {"imitation_loss": loss.item(), **(log or {}), **losses.log}
        self._require_finite_losses(log, batch)
        # Where gradients are accumulated, those of the micro-batch before: the next pop shall hold one backward pass.
        self._last_norms = self._gradient_norms.pop() or self._last_norms
        return loss + losses.total, {**log, **self._last_norms}

    def _require_finite_losses(self, log: Mapping[str, float], batch: Mapping[str, Any]) -> None:
        """Stop training that has become NaN.

        Raises:
            FloatingPointError: naming the losses that are not finite and what else is known.
        """
        bad = [name for name, value in log.items() if name in LOSSES and not math.isfinite(value)]
        if not bad:
            return
        frames = {key: value for key, value in batch.items() if isinstance(value, Tensor)}
        causes = [key for key, value in frames.items() if not bool(torch.isfinite(value).all())]
        weight = not_finite_weight(self)
        causes += [f"weight {weight}"] if weight else []
        raise FloatingPointError(
            f"training step {self.agpd.progress.step + 1}: not finite: {', '.join([*bad, *causes])}; {REMEDY}"
        )

    def update(self) -> None:
        """Advance the alternation; LeRobot calls this after every optimizer step, on every process."""
        if hasattr(super(), "update"):
            super().update()  # type: ignore[misc]
        if self._agpd is None:
            return
        self._require_finite_weights(self._agpd.progress.step + 1)
        if self._agpd.after_update():
            if self._agpd.collector is not None:
                self._agpd.collector.close()
            self._merge_episodes()

    def _require_finite_weights(self, step: int) -> None:
        """Stop before LeRobot saves weights that an update has made NaN.

        Gradients alone may be infinite: a gradient scaler (float16) then leaves the weights as they are.

        Raises:
            FloatingPointError: naming the weight.
        """
        self._last_norms = self._gradient_norms.pop() or self._last_norms
        if all(map(math.isfinite, self._last_norms.values())):
            return
        weight = not_finite_weight(self)
        if weight is not None:
            raise FloatingPointError(
                f"training step {step} has made the weight {weight} not finite; {REMEDY}"
            )

    def _merge_episodes(self) -> None:
        """Merge all kept episodes into one dataset and upload it if requested.

        A failure is logged: LeRobot has yet to write the last checkpoint, and the journal is complete as it is.
        """
        journal, collect = self.agpd.journal, self.config.collect
        if journal is None or not PartialState().is_main_process:
            return
        try:
            merged = merge(journal.root, collect.repo_id)
            if merged is not None and collect.push_to_hub:
                upload(merged, journal.root)
        except Exception:
            flags = f" --repo_id={collect.repo_id} --push_to_hub=true" if collect.push_to_hub else ""
            logger.exception(
                "the collected episodes could not be merged or uploaded; they are complete in %s. Once the cause is "
                "gone, run lerobot-agpd-merge --root=%s%s",
                journal.root,
                journal.root,
                flags,
            )

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Trainable parameters of student, discriminator and representation."""
        groups: dict[str, list[nn.Parameter]] = {"student": [], "discriminator": [], "representation": []}
        for name, parameter in self.named_parameters():
            owner = name.split(".", 1)[0]
            if parameter.requires_grad:
                groups[owner if owner in groups else "student"].append(parameter)
        return groups

    def get_optim_params(self) -> list[ParameterGroup]:
        """The student's own groups, then one each for discriminator and representation if there are any."""
        groups = self.parameter_groups()
        own = {id(parameter) for parameter in groups["student"]}
        params = [
            {**group, "params": [p for p in group["params"] if id(p) in own]}
            for group in fused_groups(super().get_optim_params())  # type: ignore[misc]
        ]
        for name, lr in (("discriminator", self.config.adversary.lr), ("representation", LR)):
            if groups[name]:
                params += fused_groups([{"params": groups[name], "lr": lr}])
        return params

    # ---- checkpoints ----

    def model_facts(self) -> ModelFacts | None:
        """What the model card says of the run; None outside of one."""
        dataset = self._training_data[0]
        if self._agpd is None or dataset is None:
            return None
        return distillation_facts(self._agpd, acting_parameters(self), dataset)

    def _save_pretrained(self, save_directory: Path, **kwargs: Any) -> None:
        super()._save_pretrained(save_directory, **kwargs)
        if self._agpd is not None and PartialState().is_main_process:
            self._agpd.save(save_directory)

    @classmethod
    def _load_as_safetensor(cls, model: Any, model_file: str, map_location: str, strict: bool) -> Any:
        require_weights(model, model_file, optional=cls.optional_weights)
        return super()._load_as_safetensor(model, model_file, map_location, strict)  # type: ignore[misc]
