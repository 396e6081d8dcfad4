"""The comparison of runs as a table, a picture and JSON."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from lerobot_agpd.analysis.evaluation import Evaluation
from lerobot_agpd.analysis.latency import Latency
from lerobot_agpd.analysis.statistics import mean, success_rate


@dataclass
class MethodResult:
    """What is reported of one method.

    Attributes:
        name: as shown.
        final: evaluation of its last checkpoint.
        latency: of its acting network.
        curve: training step to evaluation.
        collection: generated, kept, ... episodes; empty without collection.
    """

    name: str
    final: Evaluation
    latency: Latency
    curve: dict[int, Evaluation] = field(default_factory=dict)
    collection: dict[str, Any] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """Everything, with the intervals spelled out."""
        return {
            **asdict(self),
            "success": asdict(success_rate(self.final.successes)),
            "mean_max_reward": asdict(mean(self.final.max_rewards)),
        }

    @classmethod
    def from_json(cls, entry: Mapping[str, Any]) -> MethodResult:
        """The inverse of `to_json`; intervals are computed anew."""
        return cls(
            name=entry["name"],
            final=Evaluation(**entry["final"]),
            latency=Latency(**entry["latency"]),
            curve={int(step): Evaluation(**evaluation) for step, evaluation in entry["curve"].items()},
            collection=dict(entry["collection"]),
        )


HEADER = ("", "success", "mean max reward", "N", "episodes generated / kept", "parameters", "ms per chunk")


def table_rows(results: Sequence[MethodResult]) -> list[tuple[str, ...]]:
    """One row per method, in the order of HEADER; intervals are 95 %."""
    rows: list[tuple[str, ...]] = []
    for result in results:
        counts = result.collection
        rows.append(
            (
                result.name,
                str(success_rate(result.final.successes)),
                str(mean(result.final.max_rewards)),
                str(len(result.final.successes)),
                f"{counts['generated']} / {counts['kept']}" if counts else "-",
                f"{result.latency.n_parameters / 1e6:.2f} M",
                f"{result.latency.median_ms:.1f}",
            )
        )
    return rows


def markdown(results: Sequence[MethodResult]) -> str:
    """The table in markdown."""
    lines = [HEADER, tuple("---" for _ in HEADER), *table_rows(results)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def plot_curves(
    results: Sequence[MethodResult], rounds: Sequence[Mapping[str, Any]], path: Path, title: str
) -> None:
    """Success and reward against training steps, and what each collection round brought."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(1, 3, figsize=(13, 3.8), constrained_layout=True)
    for number, result in enumerate(results):
        colour = f"C{number}"
        for axis, values, estimate in (
            (axes[0], "successes", success_rate),
            (axes[1], "max_rewards", mean),
        ):
            points = {step: estimate(getattr(entry, values)) for step, entry in result.curve.items()}
            final = estimate(getattr(result.final, values))
            if points:
                steps = list(points)
                axis.plot(steps, [points[s].mean for s in steps], "o-", color=colour, label=result.name, ms=4)
                low, high = ([getattr(points[s], side) for s in steps] for side in ("low", "high"))
                axis.fill_between(steps, low, high, color=colour, alpha=0.15, lw=0)
            else:
                axis.axhline(final.mean, color=colour, ls="--", label=result.name)
                axis.axhspan(final.low, final.high, color=colour, alpha=0.1, lw=0)
    axes[0].set(title="success rate", xlabel="training step", ylim=(-0.02, 1.02))
    axes[1].set(title="mean max reward", xlabel="training step")
    axes[0].legend(loc="lower right", fontsize=8)
    _plot_rounds(axes[2], rounds)
    figure.suptitle(title)
    figure.savefig(path, dpi=120)
    plt.close(figure)


def _plot_rounds(axis: Any, rounds: Sequence[Mapping[str, Any]]) -> None:
    axis.set(title="collection rounds", xlabel="round", ylim=(-0.02, 1.02), ylabel="share of episodes passed")
    for kind, style in (("guided", "o-"), ("unguided", "s--")):
        points = [
            (entry["round"], entry[kind]["successful"] / (entry[kind]["generated"] - entry[kind]["trivial"]))
            for entry in rounds
            if entry[kind]["generated"] > entry[kind]["trivial"]
        ]
        if points:
            axis.plot(*zip(*points, strict=True), style, label=kind, ms=4)
    if rounds:
        scale = axis.twinx()
        scale.plot([entry["round"] for entry in rounds], [entry["scale"] for entry in rounds], "k:", lw=1)
        scale.set(ylabel="guidance scale (dotted)", ylim=(0, None))
        axis.legend(loc="lower right", fontsize=8)
