"""An ACT policy as an ONNX graph: raw observations in, a chunk of actions in the environment's units out."""

from __future__ import annotations

import contextlib
import io
import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.configs import FeatureType
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.utils.constants import ACTION, OBS_IMAGES
from torch import Tensor, nn

from lerobot_agpd.flag_checks import require
from lerobot_agpd.loading import LoadedPolicy
from lerobot_agpd.stopwatch import call_times

FILE = "policy.onnx"

TOLERANCE = 1e-5
"""Largest difference between the chunks of graph and policy, relative to the largest action or 1."""

REPEATS = 50


@dataclass(frozen=True)
class OnnxExport:
    """What came out.

    Attributes:
        path: of the graph.
        difference: between its chunks and the policy's, at observations that it was not made with.
        torch_ms: median time of a chunk at batch size 1, with normalization, by torch.
        onnx_ms: the same by onnxruntime; both on the CPU with the same number of threads.
    """

    path: Path
    difference: float
    torch_ms: float
    onnx_ms: float


class ChunkGraph(nn.Module):
    """What is exported: ACT's network between the processors of its checkpoint.

    Args:
        loaded: an ACT policy with its processors, on the CPU.
    """

    def __init__(self, loaded: LoadedPolicy):
        super().__init__()
        assert isinstance(loaded.policy, ACTPolicy)
        self.network = loaded.policy.model
        self.preprocessor, self.postprocessor = loaded.preprocessor, loaded.postprocessor
        self.features = dict(loaded.policy.config.input_features or {})
        self.image_features = list(loaded.policy.config.image_features)

    def forward(self, *observations: Tensor) -> Tensor:
        """Map raw observations, in the order of `features`, to a chunk (B, S, A) in the environment's units."""
        batch = self.preprocessor(dict(zip(self.features, observations, strict=True)))
        inputs: dict[str, Any] = {key: batch[key] for key in self.features}
        if self.image_features:
            inputs[OBS_IMAGES] = [batch[key] for key in self.image_features]
        return self.postprocessor(self.network(inputs)[0])

    def examples(self, batch_size: int, seed: int) -> tuple[Tensor, ...]:
        """Observations like the policy's: images in [0, 1], vectors around the origin."""
        generator = torch.Generator().manual_seed(seed)
        return tuple(
            torch.rand(batch_size, *feature.shape, generator=generator)
            if feature.type is FeatureType.VISUAL
            else torch.randn(batch_size, *feature.shape, generator=generator)
            for feature in self.features.values()
        )


def require_onnx(policy: nn.Module) -> None:
    """Refuse what cannot become a graph.

    Raises:
        FlagError: for a policy other than ACT, whose chunk is not one pass of a network.
        ModuleNotFoundError: without the packages of the extra `onnx`.
    """
    require(
        isinstance(policy, ACTPolicy),
        "--format=onnx: only ACT students become one graph; a policy that denoises is a loop around its network",
    )
    missing = [name for name in ("onnx", "onnxscript", "onnxruntime") if find_spec(name) is None]
    if missing:
        raise ModuleNotFoundError(
            f"--format=onnx needs {', '.join(missing)}: install lerobot_policy_agpd with the extra 'onnx'"
        )


def export_onnx(loaded: LoadedPolicy, folder: Path) -> OnnxExport:
    """Write `policy.onnx`, and compare it with the policy.

    Inputs are named after the observation features, (B, D) vectors and (B, C, H, W) images in [0, 1]; the output
    `action` is (B, S, A). The batch size is free.

    Args:
        loaded: an ACT policy with its processors, on the CPU.
        folder: created if missing.

    Raises:
        RuntimeError: if the graph acts differently.
    """
    from onnxruntime import InferenceSession, SessionOptions

    graph = ChunkGraph(loaded).eval()
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / FILE
    with torch.no_grad(), _quietly():
        torch.onnx.export(
            graph,
            graph.examples(batch_size=2, seed=0),
            path,
            input_names=list(graph.features),
            output_names=[ACTION],
            dynamic_shapes=(tuple({0: torch.export.Dim("batch")} for _ in graph.features),),
            external_data=False,
            dynamo=True,
        )
    options = SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    session = InferenceSession(path, options, providers=["CPUExecutionProvider"])

    def by_onnx(observations: tuple[Tensor, ...]) -> np.ndarray:
        named = {key: value.numpy() for key, value in zip(graph.features, observations, strict=True)}
        return session.run([ACTION], named)[0]

    def by_torch(observations: tuple[Tensor, ...]) -> np.ndarray:
        with torch.no_grad():
            return graph(*observations).numpy()

    difference = 0.0
    for batch_size in (1, 3):  # neither is the one it was made with
        observations = graph.examples(batch_size, seed=batch_size)
        expected, got = by_torch(observations), by_onnx(observations)
        scale = max(1.0, float(np.abs(expected).max()))
        difference = max(difference, float(np.abs(expected - got).max()) / scale)
    if difference > TOLERANCE:
        path.unlink()
        raise RuntimeError(f"the chunks of {path} differ from the policy's by {difference:.2e}")
    one = graph.examples(batch_size=1, seed=1)
    torch_ms, onnx_ms = (
        float(np.median(call_times(partial(run, one), REPEATS))) for run in (by_torch, by_onnx)
    )
    return OnnxExport(path, difference, torch_ms, onnx_ms)


@contextmanager
def _quietly() -> Iterator[None]:
    """The exporter prints its progress, and warns of what it does not fold."""
    optimizer = logging.getLogger("onnxscript")
    level = optimizer.level
    optimizer.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            yield
    finally:
        optimizer.setLevel(level)
