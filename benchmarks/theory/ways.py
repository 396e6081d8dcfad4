"""Teachers that know several ways (docs/theory.md): ways.json and ways.png beside this file.

usage: python benchmarks/theory/ways.py       (about half a minute of processor time, fixed seed)
"""

import json
import math
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from lerobot_agpd.studies.theory_ways import (
    balance_threshold,
    coupling,
    effective_scale,
    escape_probability,
    guided_agreement,
    mean_fixed_points,
    mean_map,
    median_threshold_two_ways,
    nearest_agreement,
    nearest_agrees_in_all,
    samples_needed,
    side_threshold,
    simulate_rounds,
    stuck_share,
    tilted_shares,
)

HERE = Path(__file__).parent
SPREAD, EPISODES, ROUNDS, RUNS = 0.1, 50, 8, 40
ANGLES = 2 * np.pi * np.arange(3) / 3
WAYS = {2: np.array([[1.0], [-1.0]]), 3: np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=1)}
DISTANCE = {2: 2.0, 3: math.sqrt(3)}
COUPLINGS = (0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 6.0)


def scale_of_coupling(kappa: float, n_ways: int) -> float:
    """The k of a coupling at this spread."""
    k_prime = 2 * kappa / DISTANCE[n_ways] ** 2
    return k_prime / (1 - k_prime * SPREAD**2)


def tilt(rng: np.random.Generator) -> list[dict]:
    """Shares by the formula, and by importance sampling of the mixture with the tilt's own weights."""
    rows = []
    for k in (0.5, 2.0, 8.0):
        weights, student, spread, n = np.array([0.5, 0.2, 0.3]), np.array([0.2, 0.3]), 0.4, 1_000_000
        way = rng.choice(3, n, p=weights)
        actions = WAYS[3][way] + spread * rng.standard_normal((n, 2))
        mass = np.exp(-k / 2 * np.square(actions - student).sum(axis=1))
        sampled = np.bincount(way, mass) / mass.sum()
        exact = tilted_shares(weights, WAYS[3], student, k, spread)
        rows.append(
            {
                "k": k,
                "effective": round(effective_scale(k, spread), 3),
                "exact": exact.round(4).tolist(),
                "sampled": sampled.round(4).tolist(),
            }
        )
    return rows


def rounds(rng: np.random.Generator) -> list[dict]:
    """The leading way's share after ROUNDS rounds, from balanced data, for both students and both kinds of memory."""
    rows = []
    for n_ways, ways in WAYS.items():
        start = np.full(n_ways, EPISODES // n_ways)
        for kappa in COUPLINGS:
            k = scale_of_coupling(kappa, n_ways)
            row = {"ways": n_ways, "coupling": kappa, "k distance^2": round(k * DISTANCE[n_ways] ** 2, 2)}
            row["mean_fixed_points"] = [round(share, 3) for share in mean_fixed_points(kappa, n_ways)]
            for absolute in (False, True):
                for keep in (False, True):
                    lead = []
                    for _ in range(RUNS):
                        shares = simulate_rounds(
                            rng, ways, k, SPREAD, absolute, start, EPISODES, ROUNDS, keep
                        )
                        lead.append(shares[-1].max())
                    name = f"{'median' if absolute else 'mean'}, {'all data' if keep else 'last round'}"
                    row[name] = {
                        "mean": round(float(np.mean(lead)), 3),
                        "left": float(np.mean(np.array(lead) > 0.7)),
                    }
            rows.append(row)
    return rows


def thresholds() -> dict:
    """k' distance^2 of both thresholds, and of the median's for two ways of finite spread."""
    median = {f"{ratio:g}": round(median_threshold_two_ways(ratio, 1.0), 5) for ratio in (2, 3, 4, 6, 10)}
    return {
        "mean": {
            str(n): {"balance": 2 * balance_threshold(n), "side": round(2 * side_threshold(n), 3)}
            for n in (2, 3, 4)
        },
        "median_two_ways_by_distance_over_spread": median,
    }


def escapes(rng: np.random.Generator) -> list[dict]:
    """How soon a median student leaves its place between two of three ways, in rounds of EPISODES episodes."""
    rows = []
    for kappa in (0.5, 1.0, 2.0, 4.0, 8.0):
        share = stuck_share(kappa)
        counts = rng.multinomial(EPISODES, [1 - 2 * share, share, share], size=200_000)
        rows.append(
            {
                "coupling": kappa,
                "share": round(share, 4),
                "escape": round(escape_probability(kappa, EPISODES), 5),
                "escape_sampled": round(float((counts.max(axis=1) > EPISODES // 2).mean()), 5),
                "escape_200_episodes": round(escape_probability(kappa, 200), 5),
            }
        )
    return rows


def nearest(rng: np.random.Generator) -> list[dict]:
    """Samples that `nearest` needs, and how far 8 of them agree, against sampling."""
    rows = []
    for m in (1, 2, 3, 5, 8, 12, 16):
        matches = rng.binomial(m, 0.5, (20_000, 8)).max(axis=1)
        rows.append(
            {
                "choices": m,
                "samples_for_0.9": samples_needed(0.9, m),
                "all_of_8": round(nearest_agrees_in_all(8, m), 4),
                "all_of_8_sampled": round(float((matches == m).mean()), 4),
                "agreement_of_8": round(nearest_agreement(8, m), 3),
                "agreement_of_8_sampled": round(float(matches.mean() / m), 3),
                "agreement_of_64": round(nearest_agreement(64, m), 3),
            }
        )
    return rows


def draw(result: dict, path: Path) -> None:
    figure, (left, middle, right) = plt.subplots(1, 3, figsize=(13, 3.9), layout="constrained")
    shares = np.linspace(0, 1, 401)
    left.plot(shares, shares, color="0.6", linewidth=1)
    for kappa, color in ((1.0, "tab:blue"), (2.0, "tab:purple"), (4.0, "tab:red")):
        left.plot(
            shares, [mean_map(p, kappa) for p in shares], color=color, label=f"mean, $\\kappa$ = {kappa:g}"
        )
    jump = np.where(shares > 0.5, mean_map(1.0, 1.0), mean_map(0.0, 1.0))
    left.plot(shares, jump, ":", color="tab:blue", label="median, $\\kappa$ = 1")
    left.set(
        title="a  two ways: one round", xlabel="share p in the data", ylabel="share p' in the next round"
    )
    left.legend(frameon=False, fontsize=8)

    couplings = np.linspace(0.3, 6, 160)
    for n_ways, color in ((2, "tab:blue"), (3, "tab:orange")):
        leading = [mean_fixed_points(kappa, n_ways)[-1] for kappa in couplings]
        middle.plot(couplings, leading, color=color, label=f"{n_ways} ways, stable")
        above = couplings > balance_threshold(n_ways)
        middle.plot(couplings[above], np.full(above.sum(), 1 / n_ways), "--", color=color, linewidth=1)
        points = [row for row in result["rounds"] if row["ways"] == n_ways]
        x = [row["coupling"] for row in points]
        middle.plot(x, [row["mean, last round"]["mean"] for row in points], "o", color=color, markersize=5)
        middle.plot(x, [row["median, last round"]["mean"] for row in points], "x", color=color, markersize=6)
    middle.plot([], [], "ko", markersize=5, label="simulated, mean student")
    middle.plot([], [], "kx", markersize=6, label="simulated, median student")
    middle.set(
        title=f"b  after {ROUNDS} rounds of {EPISODES} episodes",
        xlabel="coupling $\\kappa$ = k' distance$^2$ / 2",
        ylabel="share of the leading way",
        ylim=(-0.02, 1.03),
    )
    middle.legend(frameon=False, fontsize=8, loc="lower right")

    choices = np.arange(1, 17)
    for n, color in ((4, "0.75"), (16, "0.5"), (64, "0.2")):
        right.plot(
            choices, [nearest_agrees_in_all(n, m) for m in choices], color=color, label=f"nearest of {n}"
        )
    for kappa, style in ((2.0, "-"), (4.0, "--")):
        right.plot(
            choices,
            [guided_agreement(kappa) ** m for m in choices],
            style,
            color="tab:red",
            label=f"guided, $\\kappa$ = {kappa:g}",
        )
    right.set(
        title="c  several choices in one chunk",
        xlabel="independent binary choices",
        ylabel="chance that all agree",
    )
    right.legend(frameon=False, fontsize=8)
    figure.savefig(path, dpi=130)


def main() -> None:
    rng = np.random.default_rng(0)
    result = {
        "setting": {"spread": SPREAD, "episodes": EPISODES, "rounds": ROUNDS, "runs": RUNS},
        "tilt": tilt(rng),
        "thresholds": thresholds(),
        "rounds": rounds(rng),
        "escapes": escapes(rng),
        "nearest": nearest(rng),
        "guided": {f"{kappa:g}": round(guided_agreement(kappa), 4) for kappa in (1.0, 2.0, 4.0, 8.0)},
        "coupling_of_scale": {
            f"{k:g}": round(coupling(k, SPREAD, DISTANCE[2]), 3) for k in (0.5, 1.0, 2.0, 4.0)
        },
    }
    (HERE / "ways.json").write_text(json.dumps(result, indent=1) + "\n")
    draw(result, HERE / "ways.png")


if __name__ == "__main__":
    main()
