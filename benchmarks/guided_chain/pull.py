"""How far guidance pulls over samplers, by scale and by pull: benchmarks/guided_chain/pull.json.

1. gaussian: a denoiser that is exact for N(0, spread^2), by the recursion of guidance/pull.py: fraction of the way to
   the student that the mean goes, for other spreads and distances than those the pull is computed for.
2. ways: denoisers that are exact for a mixture of two or of three ways, sampled by the guided samplers themselves:
   probability of the way that the student leans to. Every reference spread at several pulls.
3. trained_teacher: that of examples/fetch_pick_and_place at its demonstrations' observations, toward a chunk that lies
   0.3 away from its own in every entry.

usage: python benchmarks/guided_chain/pull.py          (about half a minute of processor time)
"""

import json
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from diffusers.schedulers.scheduling_ddim import DDIMScheduler
from diffusers.schedulers.scheduling_ddpm import DDPMScheduler
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from torch import Tensor

from lerobot_agpd.config import TeacherConfig
from lerobot_agpd.guidance.discrepancy import ActionDiscrepancy
from lerobot_agpd.guidance.flow import guided_velocity
from lerobot_agpd.guidance.guide import Guide, GuidedScheduler
from lerobot_agpd.guidance.pull import (
    DISTANCE,
    SPREAD,
    Sampler,
    diffusion_sampler,
    flow_sampler,
    largest_pull,
    pull_of_scale,
    scale_of_pull,
)
from lerobot_agpd.loading import load_teacher

PICK_AND_PLACE = Path(__file__).parents[2] / "examples" / "fetch_pick_and_place"
STEPS = (1, 2, 5, 10, 16, 50, 100)
SCHEDULERS = {"DDPM": DDPMScheduler, "DDIM": DDIMScheduler}
MIXTURE_STEPS = (5, 10, 50)
SCALES, PULLS = (0.5, 4.0), (0.3, 0.6, 0.9)
N, ENTRIES, WITHIN, LEAN = 400, 8, 0.05, 0.4
REFERENCES = (0.1, 0.15, 0.3, 1.0)
REFERENCE_PULLS = (0.15, 0.3, 0.6)


@dataclass(frozen=True)
class Chain:
    """A sampler and where J is differentiated."""

    kind: str
    n_steps: int
    at: str

    @property
    def name(self) -> str:
        return f"{self.kind} {self.n_steps} {self.at}"

    @property
    def sampler(self) -> Sampler:
        return (
            flow_sampler(self.n_steps)
            if self.kind == "flow"
            else diffusion_sampler(scheduler(self.kind), self.n_steps)
        )


CHAINS = [
    Chain(kind, n_steps, at)
    for kind, points in (("DDPM", ("x0", "mu")), ("DDIM", ("x0", "mu")), ("flow", ("x0",)))
    for at in points
    for n_steps in STEPS
]


def scheduler(kind: str) -> DDPMScheduler | DDIMScheduler:
    return SCHEDULERS[kind](num_train_timesteps=100, beta_schedule="squaredcos_cap_v2", clip_sample=False)


def solved(chain: Chain, pull: float, spread: float = SPREAD) -> float | None:
    """The scale of a pull, None if out of reach."""
    try:
        return scale_of_pull(chain.sampler, pull, chain.at, spread, DISTANCE)
    except ValueError:
        return None


# ---- 1: exact Gaussian denoisers ----


def gaussian() -> dict:
    rows = {}
    for chain in CHAINS:
        sampler = chain.sampler
        scales = {f"scale {scale:g}": scale for scale in SCALES}
        scales |= {f"pull {pull:g}": solved(chain, pull) for pull in PULLS}
        rows[chain.name] = {
            "largest_pull": round(largest_pull(sampler, chain.at), 3),
            "scale": {name: scale and round(scale, 3) for name, scale in scales.items()},
            "fraction": {
                f"spread {spread:g}, distance {distance:g}": {
                    name: scale and round(pull_of_scale(sampler, scale, chain.at, spread, distance), 3)
                    for name, scale in scales.items()
                }
                for spread, distance in (
                    (0.05, 0.3),
                    (0.15, 0.3),
                    (0.15, 1.0),
                    (0.15, 2.0),
                    (0.3, 0.3),
                    (0.6, 0.3),
                )
            },
        }
    return rows


# ---- 2: exact mixtures ----


def clean_chunk(x: Tensor, signal: float, noise: float, ways: Tensor) -> Tensor:
    """E[x0 | x] for x = signal x0 + noise z, where x0 is one of the ways (W, H, A) plus WITHIN z; x is (B, H, A)."""
    variance = signal**2 * WITHIN**2 + noise**2
    logits = -(x[:, None] - signal * ways).square().flatten(2).sum(2) / (2 * variance)
    way = torch.einsum("bw,wha->bha", logits.softmax(1), ways)
    return way + signal * WITHIN**2 / variance * (x - signal * way)


def probability(chain: Chain, scale: float, ways: Tensor) -> float:
    """Fraction of N guided chunks that end nearest to way 0, toward which the student leans."""
    generator = torch.Generator().manual_seed(0)
    x = torch.randn((N, *ways.shape[1:]), generator=generator)
    target = (LEAN * ways[0]).expand(N, -1, -1)
    guide = Guide(ActionDiscrepancy(target, 0), torch.full((N,), scale), at=chain.at)
    if chain.kind == "flow":
        for step in range(chain.n_steps):
            tau = step / chain.n_steps
            velocity = (clean_chunk(x, tau, 1 - tau, ways) - x) / (1 - tau)
            x = x + guided_velocity(guide, x, velocity, tau, x.shape[-1]) / chain.n_steps
    else:
        plain = scheduler(chain.kind)
        proxy = GuidedScheduler(plain, guide)
        proxy.set_timesteps(chain.n_steps)
        for t in proxy.timesteps:
            signal = math.sqrt(plain.alphas_cumprod[t])
            noise = math.sqrt(1 - signal**2)
            x0_hat = clean_chunk(x, signal, noise, ways)
            x = proxy.step((x - signal * x0_hat) / noise, t, x, generator=generator).prev_sample
    nearest = (x[:, None] - ways).square().flatten(2).sum(2).argmin(1)
    return float((nearest == 0).float().mean())


def make_ways(number: int) -> Tensor:
    """Two opposite ways, or three in a plane 120 degrees apart, at 0.5 from their center: (W, ENTRIES, A)."""
    angles = 2 * math.pi * torch.arange(number) / number
    ways = 0.5 * torch.stack([angles.cos(), angles.sin()], dim=1)[:, None]
    return (ways[..., :1] if number == 2 else ways).repeat(1, ENTRIES, 1)


def summary(values: dict[str, float | None]) -> dict:
    """What the samplers have in common: extremes, mean, and the spread of the log-odds."""
    reached = np.array([value for value in values.values() if value is not None])
    inside = reached.clip(0.5 / N, 1 - 0.5 / N)
    return {
        "samplers": len(reached),
        "least": float(reached.min()),
        "mean": round(float(reached.mean()), 3),
        "most": float(reached.max()),
        "std_log_odds": round(float(np.log(inside / (1 - inside)).std()), 3),
        "by_sampler": values,
    }


def ways() -> dict:
    chains = [chain for chain in CHAINS if chain.n_steps in MIXTURE_STEPS]
    table = {}
    for number in (2, 3):
        geometry = make_ways(number)
        rows = {}
        for scale in (0.125, 0.25, *SCALES):
            rows[f"scale {scale:g}"] = {chain.name: probability(chain, scale, geometry) for chain in chains}
        for spread in REFERENCES:
            for pull in REFERENCE_PULLS:
                scales = {chain: solved(chain, pull, spread) for chain in chains}
                rows[f"pull {pull:g} at spread {spread:g}"] = {
                    chain.name: None if scale is None else probability(chain, scale, geometry)
                    for chain, scale in scales.items()
                }
        table[f"{number} ways"] = {name: summary(row) for name, row in rows.items()}
    return table


# ---- 3: a trained teacher ----


def trained_teacher() -> dict:
    dataset = LeRobotDataset("local/pick", root=PICK_AND_PLACE / "demonstrations")
    chosen = range(0, len(dataset), max(len(dataset) // 32, 1))
    frames = torch.utils.data.default_collate([dataset[n] for n in chosen])
    teacher = load_teacher(TeacherConfig(str(PICK_AND_PLACE / "teacher")), "cpu")
    history = {key: frames[key][:, None].repeat(1, teacher.n_obs_steps, 1) for key in teacher.input_features}
    rows = {}
    for chain in CHAINS:
        if chain.kind == "flow" or chain.n_steps not in (5, 10, 16, 50):
            continue
        teacher.set_sampler(chain.n_steps, chain.kind)
        alone = teacher.normalize(teacher.sample(history, None, torch.Generator().manual_seed(0)))
        way = (
            -0.3 * alone.sign()
        )  # toward the middle of the action space, where the teacher's clipping does not act
        scales: dict[str, float | None] = {f"scale {scale:g}": scale for scale in SCALES}
        scales |= {f"pull {pull:g}": solved(chain, pull) for pull in PULLS}
        row = {}
        for name, scale in scales.items():
            if scale is None:
                row[name] = None
                continue
            guide = Guide(
                ActionDiscrepancy(alone + way, teacher.start), torch.full((len(chosen),), scale), at=chain.at
            )
            moved = (
                teacher.normalize(teacher.sample(history, guide, torch.Generator().manual_seed(0))) - alone
            )
            row[name] = round(float((moved * way).sum() / way.square().sum()), 4)
        rows[chain.name] = row
    return rows


def main() -> None:
    torch.set_num_threads(1)
    result = {
        "reference": {"spread": SPREAD, "distance": DISTANCE},
        "mixture": {"samples": N, "entries": ENTRIES, "within": WITHIN, "lean": LEAN, "center_to_way": 0.5},
        "gaussian": gaussian(),
        "ways": ways(),
        "trained_teacher": trained_teacher(),
    }
    Path(__file__).with_name("pull.json").write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
