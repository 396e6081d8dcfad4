"""Gather what training, `lerobot-eval` and spread.py left behind of one teacher: an entry of teachers.json beside a script.

usage: python benchmarks/adroit/collect.py RESULT.json NAME OUTPUT_DIR
"""

import json
import sys
from dataclasses import asdict
from pathlib import Path

from safetensors import safe_open

from lerobot_agpd.studies.statistics import mean, success_rate

POLICY_KEYS = ("type", "denoiser", "prediction_type", "n_obs_steps", "horizon", "n_action_steps", "mlp")
POLICY_KEYS += ("noise_samples_per_frame", "num_inference_steps", "optimizer_lr", "scheduler_name")


def main(result: str, name: str, output: str) -> None:
    folder = Path(output)
    checkpoint = (folder / "checkpoints/last").resolve()
    policy = json.loads((checkpoint / "pretrained_model/config.json").read_text())
    train = json.loads((checkpoint / "pretrained_model/train_config.json").read_text())
    with safe_open(checkpoint / "pretrained_model/model.safetensors", "np") as weights:
        sizes = {key: weights.get_tensor(key).size for key in weights.keys()}  # noqa: SIM118  # not a dict
    [task] = json.loads((folder / "eval/eval_info.json").read_text())["per_task"]
    metrics = task["metrics"]
    entry = {
        "steps": int(checkpoint.name),
        "planned_steps": train["steps"],
        "batch_size": train["batch_size"],
        "policy": {key: policy[key] for key in POLICY_KEYS},
        "parameters": sum(sizes.values()),
        "success": asdict(success_rate(metrics["successes"])),
        "max_reward": asdict(mean(metrics["max_rewards"])),
        "sum_reward": asdict(mean(metrics["sum_rewards"])),
        "episodes": {key: metrics[key] for key in ("successes", "max_rewards", "sum_rewards")},
        "spread": json.loads((folder / "spread.json").read_text()),
    }
    path = Path(result)
    results = json.loads(path.read_text()) if path.exists() else {}
    path.write_text(json.dumps({**results, name: entry}, indent=2) + "\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
