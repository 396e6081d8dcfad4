"""Clumsy demonstrations of pushing, recorded in the real Push-T environment."""

from pathlib import Path

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.envs import make_env
from lerobot.envs.configs import PushtEnv

N_STEPS = 30


def push(agent: np.ndarray, block: np.ndarray) -> np.ndarray:
    """An action that shoves the block toward the goal: aim through it from behind."""
    goal = np.array([256.0, 256.0])
    away = (block - goal) / (np.linalg.norm(block - goal) + 1e-6)
    behind = block + 60 * away
    return goal if np.linalg.norm(agent - behind) < 40 else behind


def record(root: Path, pixels: bool) -> Path:
    """A few episodes of N_STEPS."""
    env = PushtEnv(obs_type="pixels_agent_pos" if pixels else "environment_state_agent_pos")
    envs = make_env(env, n_envs=1)["pusht"][0]
    vector = {"dtype": "float32", "names": None}
    features: dict = {"observation.state": {**vector, "shape": (2,)}, "action": {**vector, "shape": (2,)}}
    if pixels:
        names = ["height", "width", "channel"]
        features["observation.image"] = {"dtype": "image", "shape": (96, 96, 3), "names": names}
    else:
        features["observation.environment_state"] = {**vector, "shape": (16,)}
    dataset = LeRobotDataset.create("local/test", fps=10, features=features, root=root, use_videos=False)
    for episode in range(4):
        observation, info = envs.reset(seed=[episode])
        for _ in range(N_STEPS):
            block = info["block_pose"][0][:2]
            action = push(observation["agent_pos"][0], block).astype(np.float32)
            frame = {"observation.state": observation["agent_pos"][0].astype(np.float32), "action": action}
            if pixels:
                frame["observation.image"] = observation["pixels"][0]
            else:
                frame["observation.environment_state"] = observation["environment_state"][0].astype(
                    np.float32
                )
            dataset.add_frame({**frame, "task": "push"})
            observation, *_, info = envs.step(action[None])
        dataset.save_episode()
    dataset.finalize()
    envs.close()
    return root
