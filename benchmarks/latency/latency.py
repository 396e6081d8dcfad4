"""Milliseconds per action chunk of teachers and of the ACT student, at published and at smaller sizes.

All of it in one run on one machine: teachers with 100 (DDPM), 16 and 10 (DDIM) denoising steps, batch 1 (a robot) and 22
(the environments of an evaluation). Weights are random: they do not change the time. The features are those of Push-T's
state observations.
usage: python benchmarks/latency/latency.py [--device=cuda] [--threads=1] [--quick]      (writes latency-<device>.json)
"""

import argparse
import json
from dataclasses import asdict
from pathlib import Path

import torch
from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot.policies import get_policy_class
from lerobot.utils.import_utils import register_third_party_plugins

from lerobot_agpd.studies.latency import chunk_latency
from lerobot_agpd.studies.provenance import provenance

FEATURES = {
    "input_features": {
        "observation.state": PolicyFeature(FeatureType.STATE, (2,)),
        "observation.environment_state": PolicyFeature(FeatureType.ENV, (16,)),
    },
    "output_features": {"action": PolicyFeature(FeatureType.ACTION, (2,))},
}
SAMPLERS = {"100 DDPM": ("DDPM", 100), "16 DDIM": ("DDIM", 16), "10 DDIM": ("DDIM", 10)}
BATCH_SIZES = (1, 22)
SECONDS = 5.0
"""Time spent on one entry at most; one that takes longer is called once."""

DP_HORIZON = {"n_obs_steps": 2, "horizon": 16, "n_action_steps": 8}
SMALL_ACT = {"dim_model": 128, "n_heads": 4, "dim_feedforward": 512, "n_encoder_layers": 2, "use_vae": False}
ACT_CHUNK = {"chunk_size": 16, "n_action_steps": 8}

DENOISERS = {
    # Low-dimensional settings of Chi et al. (arXiv:2303.04137), as their published configurations have them.
    "DP-C, published (U-Net 256, 512, 1024)": (
        "diffusion_transformer",
        {"denoiser": "unet", "down_dims": (256, 512, 1024), "diffusion_step_embed_dim": 256, **DP_HORIZON},
    ),
    "DP-T, published (8 layers, width 256)": (
        "diffusion_transformer",
        {"denoiser": "transformer", **DP_HORIZON},
    ),
    "ACT-DP, ACT's size (width 512)": (
        "act_diffusion",
        {"dim_model": 512, "n_heads": 8, "dim_feedforward": 3200, "n_encoder_layers": 4},
    ),
    "DP-C, small (U-Net 64, 128)": (
        "diffusion_transformer",
        {"denoiser": "unet", "down_dims": (64, 128), "diffusion_step_embed_dim": 64, **DP_HORIZON},
    ),
    "MLP denoiser, 4 blocks of 640": ("diffusion_transformer", {"denoiser": "mlp", **DP_HORIZON}),
}
STUDENTS = {
    "ACT, LeRobot's defaults (width 512)": ("agpd", {"vision_backbone": "resnet18", **ACT_CHUNK}),
    "ACT, CPU preset (width 128)": ("agpd", {**SMALL_ACT, **ACT_CHUNK}),
}


def build(kind: str, fields: dict, device: str) -> torch.nn.Module:
    """A policy with random weights."""
    config_class = PreTrainedConfig.get_choice_class(kind)
    config = config_class(device=device, push_to_hub=False, **FEATURES, **fields)
    if hasattr(config, "pretrained_backbone_weights"):
        config.pretrained_backbone_weights = None
    return get_policy_class(kind)(config).to(device).eval()


def measure(name: str, sampler: str, policy: torch.nn.Module, quick: bool) -> list[dict]:
    """Latencies of one policy at every batch size."""
    entries = []
    for batch_size in BATCH_SIZES:
        latency = chunk_latency(policy, batch_size, repeats=1, warmup=0)
        repeats = 3 if quick else min(100, int(1e3 * SECONDS / latency.median_ms))
        if repeats > 1:  # else one call alone took longer than that, and stands for itself
            latency = chunk_latency(policy, batch_size, repeats)
        entries.append({"name": name, "sampler": sampler, "batch_size": batch_size, **asdict(latency)})
        print(f"{name:42s} {sampler:9s} batch {batch_size:2d}: {latency.median_ms:9.1f} ms", flush=True)
    return entries


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--quick", action="store_true", help="three repetitions, and nothing is written")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    register_third_party_plugins()
    torch.manual_seed(0)
    entries = []
    for name, (kind, fields) in STUDENTS.items():
        entries += measure(name, "-", build(kind, fields, options.device), options.quick)
    for name, (kind, fields) in DENOISERS.items():
        for sampler, (scheduler, steps) in SAMPLERS.items():
            sampling = {"noise_scheduler_type": scheduler, "num_inference_steps": steps}
            policy = build(kind, {**fields, **sampling}, options.device)
            entries += measure(name, sampler, policy, options.quick)
    if options.quick:
        return
    device = torch.cuda.get_device_name() if options.device == "cuda" else provenance()["host"]["cpu"]
    content = {"device": device, "threads": options.threads, "torch": torch.__version__, "entries": entries}
    path = Path(__file__).with_name(f"latency-{options.device}.json")
    path.write_text(json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    main()
