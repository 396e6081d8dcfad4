"""Gather what training, `lerobot-agpd-report` and spread.py left behind of one teacher: an entry of teachers.json beside a script.

usage: python benchmarks/adroit/collect.py RESULT.json NAME OUTPUT_DIR
"""

import json
import sys
from pathlib import Path

POLICY_KEYS = ("type", "denoiser", "prediction_type", "n_obs_steps", "horizon", "n_action_steps", "mlp")
POLICY_KEYS += ("noise_samples_per_frame", "num_inference_steps", "optimizer_lr", "scheduler_name")


def main(result: str, name: str, output: str) -> None:
    folder = Path(output)
    checkpoint = (folder / "checkpoints/last").resolve()
    policy = json.loads((checkpoint / "pretrained_model/config.json").read_text())
    train = json.loads((checkpoint / "pretrained_model/train_config.json").read_text())
    [method] = json.loads((folder / "report/report.json").read_text())["methods"]
    entry = {
        "steps": int(checkpoint.name),
        "planned_steps": train["steps"],
        "batch_size": train["batch_size"],
        "policy": {key: policy[key] for key in POLICY_KEYS},
        "parameters": method["latency"]["n_parameters"],
        "milliseconds_per_chunk": method["latency"]["median_ms"],
        "success": method["success"],
        "mean_max_reward": method["mean_max_reward"],
        "episodes": method["final"],
        "spread": json.loads((folder / "spread.json").read_text()),
    }
    path = Path(result)
    results = json.loads(path.read_text()) if path.exists() else {}
    path.write_text(json.dumps({**results, name: entry}, indent=2) + "\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
