"""How far a diffusion teacher's samples of one state lie apart, at states of its demonstrations.

For every state: the standard deviation of 16 sampled chunks over the executed steps and action dimensions, root mean square, in
the teacher's normalized units, where the demonstrated actions span [-1, 1]. Guidance can move a teacher only within this spread.

usage: python benchmarks/adroit/spread.py TEACHER DATASET_ROOT OUTPUT.json      (a minute on one core)
"""

import json
import sys
from pathlib import Path

import numpy as np
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.constants import ACTION
from lerobot.utils.import_utils import register_third_party_plugins

from lerobot_agpd.config import TeacherConfig
from lerobot_agpd.loading import load_teacher

N_STATES = 200
N_SAMPLES = 16
SEED = 0


def main(teacher_path: str, root: str, output: str) -> None:
    register_third_party_plugins()
    teacher = load_teacher(TeacherConfig(path=teacher_path), "cpu")
    columns = LeRobotDataset("local/demonstrations", root=root).hf_dataset.with_format("torch")[:]
    starts = torch.nonzero(columns["frame_index"] == 0)[:, 0]
    rows = torch.linspace(0, len(columns["index"]) - 1, N_STATES).long()
    first = starts[columns["episode_index"][rows]]  # of the row's episode
    offsets = torch.arange(1 - teacher.n_obs_steps, 1)
    history = {
        key: columns[key][torch.maximum(rows[:, None] + offsets, first[:, None])]
        for key in teacher.input_features
    }
    generator = torch.Generator().manual_seed(SEED)
    samples = torch.stack(
        [teacher.normalize(teacher.sample(history, generator=generator)) for _ in range(N_SAMPLES)]
    )  # (K, B, H, A)
    variance = samples[:, :, : teacher.n_action_steps].var(dim=0).mean(dim=-1)  # (B, n)
    by_state = variance.mean(dim=1).sqrt().numpy()
    at_start = columns["frame_index"][rows] < 10
    demonstrated = teacher.normalize(columns[ACTION])
    result = {
        "teacher": Path(teacher_path).parts[-4:],
        "states": N_STATES,
        "samples": N_SAMPLES,
        "executed_steps": teacher.n_action_steps,
        "spread": float(variance.mean().sqrt()),
        "spread_of_first_step": float(variance[:, 0].mean().sqrt()),
        "spread_of_last_step": float(variance[:, -1].mean().sqrt()),
        "spread_in_first_10_frames": float(variance[at_start].mean().sqrt()) if at_start.any() else None,
        "states_in_first_10_frames": int(at_start.sum()),
        "spread_by_state_quantiles": dict(
            zip(("0.1", "0.5", "0.9", "1"), np.quantile(by_state, (0.1, 0.5, 0.9, 1)).tolist(), strict=True)
        ),
        "std_of_demonstrated_actions": float(demonstrated.var(dim=0).mean().sqrt()),
    }
    Path(output).write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
