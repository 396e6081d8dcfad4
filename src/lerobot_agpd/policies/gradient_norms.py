"""Gradient norms by part of the model, before LeRobot clips them jointly."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

from torch import Tensor, nn


class GradientNorms:
    """Measures gradients as the backward pass leaves them on this process.

    LeRobot clips the gradients of all parameters together, so a discriminator with a large gradient shrinks
    the student's step; these numbers show it.
    """

    def __init__(self, groups: Mapping[str, Sequence[nn.Parameter]]):
        """Watch the parameters of every nonempty group."""
        self._squares: dict[str, list[Tensor]] = {
            name: [] for name, parameters in groups.items() if parameters
        }
        for name in self._squares:
            for parameter in groups[name]:
                parameter.register_post_accumulate_grad_hook(self._hook(name))

    def _hook(self, name: str) -> Callable[[Tensor], None]:
        def remember(parameter: Tensor) -> None:
            if parameter.grad is not None:
                self._squares[name].append(parameter.grad.detach().square().sum())

        return remember

    def pop(self) -> dict[str, float]:
        """Norms of the last backward pass, as `grad_norm_<group>`; empty before the first."""
        norms = {}
        for name, squares in self._squares.items():
            if squares:
                norms[f"grad_norm_{name}"] = math.sqrt(sum(float(square) for square in squares))
                squares.clear()
        return norms
