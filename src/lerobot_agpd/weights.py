"""Reading and writing checkpoints: strict checks of weights, and which process writes files."""

from __future__ import annotations

from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from torch import nn


def require_weights(model: nn.Module, file: str, optional: tuple[str, ...] = ()) -> None:
    """Refuse a weights file that does not fill the model; LeRobot only warns of missing weights.

    Args:
        model: the model to be filled.
        file: path of a .safetensors file.
        optional: parts (first component of a parameter's name) that may be missing; they keep their
            initial values.

    Raises:
        ValueError: if the file is unreadable, lacks weights, or holds some of another shape.
    """
    stored = stored_shapes(file, "is the checkpoint complete?")
    expected = {key: tuple(value.shape) for key, value in model.state_dict().items()}
    missing = sorted(key for key in expected if key not in stored and key.split(".")[0] not in optional)
    wrong = sorted(
        f"{key}: {stored[key]} instead of {shape}"
        for key, shape in expected.items()
        if key in stored and stored[key] != shape
    )
    if missing or wrong:
        raise ValueError(
            f"{file} does not fit the policy that its config.json describes; missing: {missing[:5]} "
            f"({len(missing)} in all), of another shape: {wrong[:5]} ({len(wrong)} in all)"
        )


def stored_shapes(file: str | Path, remedy: str) -> dict[str, tuple[int, ...]]:
    """Names and shapes of the tensors in a .safetensors file, of which only the header is read.

    Raises:
        ValueError: naming the file if it is missing, damaged or truncated, with `remedy`: what to do then.
    """
    try:
        with safe_open(file, framework="pt") as tensors:
            return {key: tuple(tensors.get_slice(key).get_shape()) for key in tensors.keys()}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise ValueError(f"{file} cannot be read as a safetensors file ({error}); {remedy}") from error


def not_finite_weight(model: nn.Module) -> str | None:
    """Name of the first tensor of a model that holds NaN, or as a parameter infinite values; None if there is none.

    A buffer may hold infinite values on purpose: attention masks do.
    """
    parameters = dict(model.named_parameters())
    for name, tensor in model.state_dict(keep_vars=True).items():
        if tensor.is_floating_point() and bool(torch.isnan(tensor).any()):
            return name
        if name in parameters and not bool(torch.isfinite(tensor).all()):
            return name
    return None


def acting_parameters(policy: nn.Module) -> int:
    """Count the parameters of the acting network; a student's discriminator and representation only train."""
    network = getattr(policy, "model", None) or getattr(policy, "diffusion", None) or policy
    return sum(parameter.numel() for parameter in network.parameters())


def is_main_process() -> bool:
    """Whether this process writes the files of a run; later versions of LeRobot save on every process."""
    from accelerate import PartialState

    return PartialState().is_main_process
