"""Parameter groups that one call updates."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from torch import Tensor

ParameterGroup = dict[str, Any]
"""Parameters, and the settings of torch's optimizer that they have for themselves."""

FUSED_DEVICES = ("cpu", "cuda")
"""Where torch's Adam and AdamW have a kernel for the whole update."""


def fused_groups(params: Iterable[Tensor] | Iterable[ParameterGroup]) -> list[ParameterGroup]:
    """Groups that Adam and AdamW update by one kernel: on a CPU torch otherwise loops over them in Python."""
    entries: list[Any] = list(params)
    groups = entries if entries and isinstance(entries[0], dict) else [{"params": entries}]
    return [_fused({**group, "params": list(group["params"])}) for group in groups]


def _fused(group: ParameterGroup) -> ParameterGroup:
    can = all(p.device.type in FUSED_DEVICES and p.is_floating_point() for p in group["params"])
    return {**group, "fused": True} if can else group
