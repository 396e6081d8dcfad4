"""Exponential moving average (EMA) of a policy's weights, swapped in for evaluation and saving."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch
from diffusers.training_utils import EMAModel
from safetensors.torch import load_file, save_file
from torch import nn

logger = logging.getLogger(__name__)

POWER = 0.75
"""The decay after n steps is 1 - (1 + n) ** -POWER; this value and the next are those of arXiv:2303.04137."""

MAX_DECAY = 0.9999
"""Upper limit of the decay."""

RAW_WEIGHTS = "raw_weights.safetensors"
"""The weights the optimizer works on, beside the averaged ones in model.safetensors; only resuming reads them."""

STEPS_KEY = "ema_steps"
"""Entry of that file: the optimizer steps averaged so far."""


class AveragedWeights:
    """The moving average of a module's parameters.

    Running statistics of batch normalization are not averaged.

    Args:
        module: the module in training; the average starts from its current weights.

    Attributes:
        active: whether the module holds the average at present, rather than the raw weights.
    """

    def __init__(self, module: nn.Module):
        if any(isinstance(part, nn.modules.batchnorm._BatchNorm) for part in module.modules()):
            logger.warning(
                "batch normalization's running statistics are not averaged with the weights; consider "
                "--policy.use_group_norm=true --policy.pretrained_backbone_weights=null"
            )
        self.active = False
        self._module = module
        self._ema = EMAModel(
            module.parameters(), decay=MAX_DECAY, use_ema_warmup=True, power=POWER, foreach=True
        )

    def step(self) -> None:
        """Add the raw weights after an optimizer step to the average."""
        self._ema.step(self._module.parameters())

    def activate(self, active: bool) -> None:
        """Let the module hold the average, or the raw weights again."""
        if active == self.active:
            return
        if active:
            self._ema.store(self._module.parameters())
            self._ema.copy_to(self._module.parameters())
        else:
            self._ema.restore(self._module.parameters())
        self.active = active

    @contextmanager
    def activated(self, active: bool) -> Iterator[None]:
        """Activate the average, or the raw weights, for a while."""
        before = self.active
        self.activate(active)
        try:
            yield
        finally:
            self.activate(before)

    def save_raw(self, folder: Path) -> None:
        """Write the raw weights beside a checkpoint's averaged ones."""
        with self.activated(False):  # while writing, too: on a CPU these are the module's own tensors
            raw = {key: value.contiguous().cpu() for key, value in self._module.state_dict().items()}
            raw[STEPS_KEY] = torch.tensor(self._ema.optimization_step)
            save_file(raw, folder / RAW_WEIGHTS)

    def load_raw(self, folder: Path) -> None:
        """Continue a checkpoint whose average the module holds: read its raw weights into the module.

        Raises:
            FileNotFoundError: if the checkpoint was saved without them.
        """
        path = folder / RAW_WEIGHTS
        if not path.is_file():
            raise FileNotFoundError(
                f"{path} is missing: this checkpoint cannot be resumed with averaged weights. Start a new run "
                "from it with --policy.path, or pass --policy.ema=false"
            )
        raw = load_file(path)
        self._ema.optimization_step = int(raw.pop(STEPS_KEY))
        self._module.load_state_dict(raw)
