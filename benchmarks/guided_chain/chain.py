"""Where the guided chain ends, for a denoiser that is exact for Gaussian data: benchmarks/guided_chain/chain.json.

Data N(0, 0.3^2), student at 0.3, action discrepancy, trust region out of the way. Reported: mean of the samples
over the student's position; 0 is the teacher alone, 1 the student.
usage: python benchmarks/guided_chain/chain.py
"""

import json
from pathlib import Path

import torch
from diffusers.schedulers.scheduling_ddim import DDIMScheduler
from diffusers.schedulers.scheduling_ddpm import DDPMScheduler

from lerobot_agpd.guidance import guide as guidance
from lerobot_agpd.guidance.discrepancy import ActionDiscrepancy
from lerobot_agpd.guidance.guide import Guide, GuidedScheduler

guidance.TRUST_REGION = 1e9

STD, STUDENT, N = 0.3, 0.3, 40_000
SCALES = (0.5, 1.0, 2.0, 4.0, 16.0)
CHAINS = {
    "DDIM 10": (DDIMScheduler, 10),
    "DDIM 16": (DDIMScheduler, 16),
    "DDPM 10": (DDPMScheduler, 10),
    "DDPM 100": (DDPMScheduler, 100),
}


def final_mean(scheduler_class: type, n_steps: int, scale: float, at: str) -> float:
    """Mean of N guided samples over the student's position."""
    generator = torch.Generator().manual_seed(0)
    target = torch.full((N, 1, 1), STUDENT)
    guide = Guide(ActionDiscrepancy(target, 0), torch.full((N,), scale), at=at)
    plain = scheduler_class(num_train_timesteps=100, beta_schedule="squaredcos_cap_v2", clip_sample=False)
    scheduler = GuidedScheduler(plain, guide)
    scheduler.set_timesteps(n_steps)
    x = torch.randn((N, 1, 1), generator=generator)
    for t in scheduler.timesteps:
        abar = plain.alphas_cumprod[t]
        x0_hat = abar.sqrt() * STD**2 / (abar * STD**2 + 1 - abar) * x  # E[x0 | x_t] for N(0, STD^2)
        noise = (x - abar.sqrt() * x0_hat) / (1 - abar).sqrt()
        x = scheduler.step(noise, t, x, generator=generator).prev_sample
    return float(x.mean()) / STUDENT


def main() -> None:
    table = {
        f"{name} at {at}": {str(scale): round(final_mean(*chain, scale, at), 3) for scale in SCALES}
        for name, chain in CHAINS.items()
        for at in ("x0", "mu")
    }
    path = Path(__file__).with_name("chain.json")
    path.write_text(
        json.dumps({"data_std": STD, "student": STUDENT, "n": N, "mean_over_student": table}, indent=2) + "\n"
    )
    for name, row in table.items():
        print(f"| {name} | " + " | ".join(f"{value:.2f}" for value in row.values()) + " |")


if __name__ == "__main__":
    main()
