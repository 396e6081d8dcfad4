"""How often `find_ways` errs on samples whose number of ways is known: ways.json beside this file.

usage: python benchmarks/probe/ways.py      (half a minute on one free core)
"""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np

from lerobot_agpd.studies.probe_ways import find_ways

RESULT = Path(__file__).parent / "ways.json"
DIM = 16
SAMPLES = (128, 256)
SINGLE_TRIALS, MIXTURE_TRIALS = 100, 50
WEIGHTS = {
    "2 even": [1 / 2] * 2,
    "2, 0.8 and 0.2": [0.8, 0.2],
    "2, 0.9 and 0.1": [0.9, 0.1],
    "3 even": [1 / 3] * 3,
    "3, 0.6, 0.3 and 0.1": [0.6, 0.3, 0.1],
    "8 even": [1 / 8] * 8,
}
SEPARATIONS = (3, 4, 6)
"""Distances of the centers in standard deviations of a way along its longest direction."""

Noise = Callable[[np.random.Generator, int], np.ndarray]


def smooth(rng: np.random.Generator, n: int) -> np.ndarray:
    """8 steps of 2 actions that follow 3 cosines each, as a teacher's chunks do; longest direction 1 long."""
    cosines = np.cos(np.pi * np.arange(3)[:, None] * np.linspace(0, 1, 8)) / np.sqrt(8)
    return (rng.normal(size=(n, 2, 3)) / np.arange(1, 4) @ cosines).reshape(n, DIM)


def line(draw: Noise) -> Noise:
    return lambda rng, n: draw(rng, n)[:, :1] * rng.normal(size=DIM)


def arc(half: float) -> Noise:
    def draw(rng: np.random.Generator, n: int) -> np.ndarray:
        angle = rng.uniform(-half, half, n)
        points = 0.05 * rng.normal(size=(n, DIM))
        points[:, 0] += np.cos(angle)
        points[:, 1] += np.sin(angle)
        return points

    return draw


SINGLE: dict[str, Noise] = {
    "Gaussian, 2 dimensions": lambda rng, n: rng.normal(size=(n, 2)),
    "Gaussian, 16 dimensions": lambda rng, n: rng.normal(size=(n, DIM)),
    "Gaussian, 64 dimensions": lambda rng, n: rng.normal(size=(n, 64)),
    "smooth chunks": smooth,
    "anisotropic, 1 to 0.01": lambda rng, n: rng.normal(size=(n, DIM)) * np.geomspace(1, 0.01, DIM),
    "Gaussian on a line": line(lambda rng, n: rng.normal(size=(n, 1))),
    "uniform on a line": line(lambda rng, n: rng.uniform(size=(n, 1))),
    "exponential on a line": line(lambda rng, n: rng.exponential(size=(n, 1))),
    "arc of 230 degrees": arc(2.0),
    "ring": arc(np.pi),
    "Student's t, 3 degrees of freedom": lambda rng, n: rng.standard_t(3, size=(n, DIM)),
    "log-normal plane": lambda rng, n: np.exp(rng.normal(size=(n, 2))) @ rng.normal(size=(2, DIM)),
    "Gaussian clipped at 1": lambda rng, n: np.clip(rng.normal(size=(n, DIM)) + 0.8, -1, 1),
}


def mixture(rng: np.random.Generator, n: int, weights: list[float], separation: float) -> np.ndarray:
    """Smooth chunks around centers in orthogonal directions."""
    rotation = np.linalg.qr(rng.normal(size=(DIM, DIM)))[0]
    centers = rotation[: len(weights)] * separation / np.sqrt(2)
    return centers[rng.choice(len(weights), n, p=weights)] + smooth(rng, n)


def main() -> None:
    rng, rows = np.random.default_rng(0), []
    for n in SAMPLES:
        for name, draw in SINGLE.items():
            several = [len(find_ways(draw(rng, n))) > 1 for _ in range(SINGLE_TRIALS)]
            rows.append({"samples": n, "single": name, "several": float(np.mean(several))})
        for name, weights in WEIGHTS.items():
            for separation in SEPARATIONS:
                found = np.array(
                    [len(find_ways(mixture(rng, n, weights, separation))) for _ in range(MIXTURE_TRIALS)]
                )
                right, several = float(np.mean(found == len(weights))), float(np.mean(found > 1))
                rows.append(
                    {
                        "samples": n,
                        "mixture": name,
                        "separation": separation,
                        "right": right,
                        "several": several,
                    }
                )
        RESULT.write_text("[\n" + ",\n".join(json.dumps(row) for row in rows) + "\n]\n")


if __name__ == "__main__":
    main()
