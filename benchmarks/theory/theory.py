"""The numbers and the picture of docs/theory.md: theory.json and theory.png beside this file.

usage: python benchmarks/theory/theory.py       (under a minute on one core, fixed seed)
"""

import json
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from scipy.optimize import brentq

from lerobot_agpd.studies.theory_coverage import best_coverage_bound, coverage_probability
from lerobot_agpd.studies.theory_guidance import (
    Mixing,
    Policies,
    Tilt,
    compare,
    fraction_at_equal_variance,
    guide,
    kl_to_teacher,
    mix,
)

HERE = Path(__file__).parent
SEED, DRAWS = 0, 50_000
CASES = [(tilt, mixing) for tilt in Tilt for mixing in Mixing]
EPSILON, N = 0.3, 100
PULL = {
    "policies": Policies(1.0, 0.0, 2.0, dim=2),
    "sigma_s": 0.3,
}  # a deterministic student two sigma_E away


def four_cases(rng: np.random.Generator) -> dict:
    """How often k >= 0 can match mixing's variance, and how often Eq. 15 then holds."""
    counts = {f"{tilt}/{mixing}": {"matched": 0, "eq_15_holds": 0} for tilt, mixing in CASES}
    below = {name: {"matched": 0, "eq_15_holds": 0} for name in counts if name.endswith("interpolate")}
    for _ in range(DRAWS):
        var_teacher, var_student = 10 ** rng.uniform(-1, 1, 2)
        policies = Policies(var_teacher, var_student, rng.uniform(0, 3), int(rng.integers(1, 9)))
        lam = rng.uniform(0, 1)
        threshold = var_teacher / (var_teacher + var_student)
        for tilt, mixing in CASES:
            share = fraction_at_equal_variance(policies, lam, tilt, mixing)
            if not 0 <= share <= 1:
                continue
            tables = [counts] + ([below] if mixing is Mixing.INTERPOLATE and lam < threshold else [])
            for table in tables:
                table[f"{tilt}/{mixing}"]["matched"] += 1
                table[f"{tilt}/{mixing}"]["eq_15_holds"] += int(share < lam)
    return {"draws": DRAWS, "cases": counts, "interpolation_with_lambda_below_threshold": below}


def examples() -> dict:
    """Single comparisons that the page quotes."""
    settings = {
        "printed (Eq. 9, 7)": (Policies(1.0, 4.0, 1.0), Tilt.STUDENT, Mixing.SWITCH),
        "algorithm (Eq. 20, 7)": (Policies(1.0, 0.0, 0.8), Tilt.TEACHER, Mixing.SWITCH),
        "algorithm (Eq. 20, 6)": (Policies(1.0, 0.0, 0.8), Tilt.TEACHER, Mixing.INTERPOLATE),
    }
    found = {}
    for name, (policies, tilt, mixing) in settings.items():
        result = compare(policies, 0.3, tilt, mixing)
        found[name] = {
            "lambda": 0.3,
            "k": result.k,
            "share_guided": result.guided.fraction,
            "variance": result.guided.variance,
            "kl_guided": float(result.kl_guided),
            "kl_mixed": float(result.kl_mixed),
        }
    return found


def noise() -> dict:
    """Coverage against the noise in the data: test noise growing with it, or fixed."""
    sigmas = np.geomspace(0.03, 3, 61)
    curves = {
        "bound": [max(best_coverage_bound(s, EPSILON, N, 2), 0) for s in sigmas],
        "matched": [coverage_probability(s, EPSILON, N, 2) for s in sigmas],
        "fixed": [coverage_probability(s, EPSILON, N, 2, 0.3) for s in sigmas],
        "drifted": [coverage_probability(s, EPSILON, N, 2, 0.3, 1.5) for s in sigmas],
    }
    best = {name: float(sigmas[int(np.argmax(curves[name]))]) for name in ("fixed", "drifted")}
    table = {
        str(s): {"bound": best_coverage_bound(s, 0.3, 100, 1), "P_S": coverage_probability(s, 0.3, 100, 1)}
        for s in (0.2, 0.3, 0.5, 1.0)
    }
    return {
        "sigma": sigmas.tolist(),
        "curves": curves,
        "best_sigma": best,
        "highest": {name: max(curves[name]) for name in best},
        "dim_1": table,
    }


def bound_excess() -> dict:
    """Largest amount by which Eq. 4, at its best `a`, exceeds the exact P_S, per dimension."""
    excess = {}
    for dim in (1, 2, 5, 10, 20, 30, 35, 38, 39, 40, 45, 50, 100):
        gaps = [0.0]
        for ratio in np.geomspace(0.01, 100, 121):
            for n in (1, 2, 5, 10, 30, 100, 1000, 10**5):
                bound = best_coverage_bound(1.0, ratio, n, dim)
                if bound > 0:
                    gaps.append(bound - coverage_probability(1.0, ratio, n, dim))
        excess[str(dim)] = float(max(gaps))
    return excess


def coverage_of_student(policies: Policies, law, sigma_s: float) -> float:
    """P_S of the student's next states, s' = s + a + noise, in data collected with `law`'s actions."""
    sigma = float(np.sqrt(sigma_s**2 + law.variance))
    sigma_test = float(np.sqrt(sigma_s**2 + policies.var_student))
    return coverage_probability(
        sigma, EPSILON, N, policies.dim, sigma_test, (1 - law.fraction) * policies.gap
    )


def guided_at(policies: Policies, share: float):
    return guide(policies, share / ((1 - share) * policies.var_teacher), Tilt.TEACHER)


def pull() -> dict:
    """Divergence from the teacher and coverage of the student's next states as both methods pull harder."""
    policies, sigma_s = PULL["policies"], PULL["sigma_s"]
    rows = {"share": [], "guided": [], "interpolated": []}
    for share in np.linspace(0, 0.9, 46):
        rows["share"].append(float(share))
        for name, law in (
            ("guided", guided_at(policies, share)),
            ("interpolated", mix(policies, share, Mixing.INTERPOLATE)),
        ):
            rows[name].append(
                {
                    "variance": float(law.variance),
                    "kl": float(kl_to_teacher(policies, law)),
                    "coverage": coverage_of_student(policies, law, sigma_s),
                }
            )
    return rows


def equal_divergence(rng: np.random.Generator, draws: int = 400) -> dict:
    """At equal KL from the teacher: how often guidance covers the student's next states better."""
    wins = ties = 0
    for _ in range(draws):
        policies = Policies(1.0, 0.0, rng.uniform(0.3, 3), int(rng.integers(1, 5)))
        sigma_s, lam = rng.uniform(0.05, 0.5), rng.uniform(0.05, 0.8)
        mixed = mix(policies, lam, Mixing.INTERPOLATE)
        kl = float(kl_to_teacher(policies, mixed))
        share = brentq(
            lambda v, p=policies, kl=kl: float(kl_to_teacher(p, guided_at(p, v))) - kl, 0, 1 - 1e-12
        )
        difference = coverage_of_student(policies, guided_at(policies, share), sigma_s) - coverage_of_student(
            policies, mixed, sigma_s
        )
        ties += abs(difference) < 1e-3
        wins += difference >= 1e-3
    return {"draws": draws, "guidance_covers_more": int(wins), "within_0.001": int(ties)}


def plot_shares(axes, policies: Policies, tilt: Tilt, title: str, labels: dict) -> None:
    lam = np.linspace(0, 1, 401)
    axes.fill_between(lam, lam, 1, color="0.93", lw=0)
    axes.plot(lam, lam, color="0.35", lw=1.2, ls=":")
    for mixing, label, color in (
        (Mixing.SWITCH, "against choosing\none (Eq. 7)", "C0"),
        (Mixing.INTERPOLATE, "against interpo-\nlating (Eq. 6)", "C1"),
    ):
        share = np.array([fraction_at_equal_variance(policies, x, tilt, mixing) for x in lam])
        share[(share < 0) | (share > 1)] = np.nan
        axes.plot(lam, share, color=color, lw=2)
        axes.text(*labels[mixing], label, color=color)
    threshold = policies.var_teacher / (policies.var_teacher + policies.var_student)
    axes.plot(threshold, threshold, "o", color="C1", ms=6, zorder=3)
    axes.text(0.03, 0.93, "guidance farther from teacher", color="0.35", va="top")
    axes.text(0.97, 0.04, "guidance closer (Eq. 15)", color="0.35", ha="right")
    axes.set(xlim=(0, 1), ylim=(0, 1), title=title, xlabel=r"mixing weight $\lambda$")
    axes.set_ylabel("guided mean, 0 teacher to 1 student")


def picture(numbers: dict) -> None:
    plt.rcParams.update({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False})
    figure, grid = plt.subplots(2, 2, figsize=(9.6, 7.6), layout="constrained")
    plot_shares(
        grid[0, 0],
        Policies(1.0, 4.0, 1.0),
        Tilt.STUDENT,
        "a  As printed: tilt the student (Eq. 9)\n" + r"$\sigma_A = 2\,\sigma_E$, gap $1\,\sigma_E$",
        {Mixing.SWITCH: (0.08, 0.6), Mixing.INTERPOLATE: (0.43, 0.15)},
    )
    plot_shares(
        grid[0, 1],
        Policies(1.0, 0.25, 0.6),
        Tilt.TEACHER,
        "b  As run: tilt the teacher (Eq. 20)\n" + r"$\sigma_A = 0.5\,\sigma_E$, gap $0.6\,\sigma_E$",
        {Mixing.SWITCH: (0.5, 0.19), Mixing.INTERPOLATE: (0.07, 0.58)},
    )

    axes, data = grid[1, 0], numbers["noise"]
    for name, label, at, style in (
        ("matched", "test noise = training noise", (0.032, 1.02), {"color": "C2", "lw": 2}),
        ("bound", "Eq. 4 for the same", (0.072, 0.40), {"color": "C2", "lw": 1.5, "ls": "--"}),
        ("fixed", "test noise fixed\nat 0.3", (0.15, 0.73), {"color": "C3", "lw": 2}),
        ("drifted", "fixed at 0.3,\nstudent 1.5 away", (0.72, 0.18), {"color": "C4", "lw": 2}),
    ):
        axes.plot(data["sigma"], data["curves"][name], **style)
        axes.text(*at, label, color=style["color"])
    axes.set(
        xscale="log",
        ylim=(0, 1.08),
        xlabel=r"noise $\sigma$ of next states in the data",
        ylabel="coverage $P_S$",
    )
    axes.set_xticks([0.03, 0.1, 0.3, 1, 3], ["0.03", "0.1", "0.3", "1", "3"])
    axes.minorticks_off()
    axes.set_title(f"c  More noise, more coverage?\nd = 2, N = {N}, " + rf"$\epsilon$ = {EPSILON}")

    axes, data = grid[1, 1], numbers["pull"]
    for name, label, color in (("guided", "guidance", "C0"), ("interpolated", "interpolation", "C1")):
        kl, coverage = ([row[key] for row in data[name]] for key in ("kl", "coverage"))
        axes.plot(kl, coverage, color=color, lw=2, label=label)
        for share in (0.3, 0.5, 0.7):
            at = int(np.argmin(np.abs(np.array(data["share"]) - share)))
            axes.plot(kl[at], coverage[at], "o", color=color, ms=5)
            axes.annotate(
                f"{share:.1f}",
                (kl[at], coverage[at]),
                textcoords="offset points",
                xytext=(5, -11),
                color=color,
            )
    axes.set(xlim=(0, 3.2), ylim=(0.4, 1.02), xlabel="KL from the teacher (nats, Eq. 14)")
    axes.set_ylabel("coverage $P_S$ of the student's next states")
    axes.set_title(
        "d  Coverage bought by divergence\ndeterministic student, gap $2\\,\\sigma_E$; dots: share of the gap"
    )
    axes.legend(frameon=False, loc="lower right")
    figure.savefig(HERE / "theory.png", dpi=150, metadata={"Software": None})


def main() -> None:
    rng = np.random.default_rng(SEED)
    numbers = {
        "seed": SEED,
        "four_cases": four_cases(rng),
        "examples": examples(),
        "noise": noise(),
        "bound_excess": bound_excess(),
        "pull": pull(),
        "equal_divergence": equal_divergence(rng),
    }
    rounded = json.loads(json.dumps(numbers), parse_float=lambda text: float(f"{float(text):.5g}"))
    (HERE / "theory.json").write_text(json.dumps(rounded, indent=1) + "\n")
    picture(numbers)


if __name__ == "__main__":
    main()
