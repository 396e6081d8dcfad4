"""Demonstrations of the point environment of tests/plugins, which need no simulator."""

from pathlib import Path

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

N_DEMONSTRATIONS, N_FRAMES = 12, 8


def make_demonstrations(root: Path, fps: int = 10) -> Path:
    """Write walks straight to the goal, in twelve directions; returns the dataset's folder."""
    vector = {"dtype": "float32", "shape": (2,), "names": None}
    keys = ("observation.state", "observation.environment_state", "action")
    dataset = LeRobotDataset.create(
        "local/test", fps=fps, features=dict.fromkeys(keys, vector), root=root, use_videos=False
    )
    for angle in np.linspace(0, 2 * np.pi, N_DEMONSTRATIONS, endpoint=False):
        goal = np.array([np.cos(angle), np.sin(angle)], dtype=np.float32)
        for step in range(N_FRAMES):
            values = (goal * min(step / 4, 1), goal, goal * (step < 4))
            dataset.add_frame({**dict(zip(keys, map(np.float32, values), strict=True)), "task": "walk"})
        dataset.save_episode()
    dataset.finalize()
    return root
