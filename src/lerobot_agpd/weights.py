"""Check of a checkpoint's weights: LeRobot loads them non-strictly and only warns of what is missing."""

from __future__ import annotations

from safetensors import safe_open
from torch import nn


def require_weights(model: nn.Module, file: str, optional: tuple[str, ...] = ()) -> None:
    """Refuse a weights file that does not fill the model.

    Args:
        model: the model to be filled.
        file: path of a .safetensors file.
        optional: parts (first component of a parameter's name) that may be missing; they keep their
            initialisation.

    Raises:
        ValueError: if the file is unreadable, lacks weights, or holds some of another shape.
    """
    try:
        with safe_open(file, framework="pt") as weights:
            found = {key: tuple(weights.get_slice(key).get_shape()) for key in weights.keys()}  # noqa: SIM118
    except Exception as error:
        raise ValueError(
            f"{file} cannot be read as a safetensors file ({error}); is the checkpoint complete?"
        ) from error
    expected = {key: tuple(value.shape) for key, value in model.state_dict().items()}
    missing = sorted(key for key in expected if key not in found and key.split(".")[0] not in optional)
    wrong = sorted(
        f"{key}: {found[key]} instead of {shape}"
        for key, shape in expected.items()
        if key in found and found[key] != shape
    )
    if missing or wrong:
        raise ValueError(
            f"{file} does not fit the policy that its config.json describes; missing: {missing[:5]} "
            f"({len(missing)} in all), of another shape: {wrong[:5]} ({len(wrong)} in all)"
        )
