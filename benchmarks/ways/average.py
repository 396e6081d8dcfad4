"""What a deterministic student makes of demonstrations that know several ways: average.json beside this file.

No teacher, no rounds: a regression network of (position, velocity) to a chunk of 16 actions is trained on episodes of
the scripted expert and executes 8 of them per prediction. One row per task, loss, fractions of the ways and number of
demonstrations.

usage: python benchmarks/ways/average.py      (10 to 20 s on one free core per row)
"""

import json
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor, nn

from lerobot_agpd.envs.base import AGENT_POS
from lerobot_agpd.envs.experts.point_maze import EXPERTS
from lerobot_agpd.envs.experts.ways import WaysExpert
from lerobot_agpd.envs.maze_tasks import TASKS
from lerobot_agpd.envs.point_maze import PointMazeWaysEnv

RESULT = Path(__file__).parent / "average.json"
CHUNK, EXECUTED = 16, 8
STEPS, BATCH = 1000, 128
EPISODES, FIRST_SEED = 50, 100_000
LOSSES = {"L1": nn.L1Loss(), "L2": nn.MSELoss()}

SETTINGS = [
    ("ThreeExits-v0", "L1", None, 120),
    ("ThreeExits-v0", "L2", None, 120),
    ("ThreeExits-v0", "L1", (0.0, 0.0, 1.0), 120),
    ("ThreeExits-v0", "L1", (0.2, 0.2, 0.6), 120),
    ("ThreeExits-v0", "L1", None, 20),
    ("TwoWays-v0", "L1", None, 120),
    ("TwoWays-v0", "L2", None, 120),
    ("Chain-v0", "L1", None, 120),
    ("Chain-v0", "L2", None, 120),
]
"""Task, loss, fractions of the ways (None: all alike), demonstrations."""


def demonstrate(env: gym.Env, expert: WaysExpert, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """States (T, 4) of one episode and the chunks (T, CHUNK, 2) that follow, the last action repeated."""
    follower = expert.for_episode(np.random.default_rng([7, seed]))
    env.reset(seed=seed)
    states, actions, done = [], [], False
    while not done:
        observation = env.unwrapped.state
        states.append(observation[AGENT_POS])
        actions.append(follower(observation))
        _, _, terminated, truncated, _ = env.step(actions[-1])
        done = terminated or truncated
    padded = np.array(actions + actions[-1:] * CHUNK)
    return np.array(states), np.stack([padded[i : i + CHUNK] for i in range(len(actions))])


def train(states: Tensor, chunks: Tensor, loss: nn.Module) -> nn.Module:
    """Regression network of normalized states (N, 4) to normalized chunks (N, CHUNK * 2)."""
    torch.manual_seed(0)
    widths = [states.shape[1], 128, 128, 128]
    layers = [
        layer for i, o in zip(widths, widths[1:], strict=False) for layer in (nn.Linear(i, o), nn.SiLU())
    ]
    network = nn.Sequential(*layers, nn.Linear(widths[-1], chunks.shape[1]))
    optimizer = torch.optim.AdamW(network.parameters(), 1e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, STEPS)
    for _ in range(STEPS):
        batch = torch.randint(len(states), (BATCH,))
        optimizer.zero_grad()
        loss(network(states[batch]), chunks[batch]).backward()
        optimizer.step()
        schedule.step()
    return network


def run(task: str, loss: str, fractions: tuple[float, ...] | None, n_demonstrations: int) -> dict:
    """Train and evaluate one student."""
    env, spec = PointMazeWaysEnv(task=task).make_single(), TASKS[task]
    way_of = lambda states: spec.way_of(states, states[:, :0])  # noqa: E731  positions suffice
    expert = EXPERTS[task] if fractions is None else EXPERTS[task].with_ways(fractions)
    episodes = [demonstrate(env, expert, seed) for seed in range(n_demonstrations)]
    states = torch.tensor(np.concatenate([states for states, _ in episodes]))
    chunks = torch.tensor(np.concatenate([chunks for _, chunks in episodes])).flatten(1)
    mean, std = (states.mean(0), chunks.mean(0)), (states.std(0), chunks.std(0))
    network = train((states - mean[0]) / std[0], (chunks - mean[1]) / std[1], LOSSES[loss])

    successes, ways, ends = [], [], []
    for seed in range(FIRST_SEED, FIRST_SEED + EPISODES):
        observation, info = env.reset(seed=seed)
        path, done = [], False
        while not done:
            with torch.no_grad():
                state = (torch.tensor(observation[AGENT_POS]) - mean[0]) / std[0]
                chunk = (network(state) * std[1] + mean[1]).view(CHUNK, -1).clamp(-1, 1).numpy()
            for action in chunk[:EXECUTED]:
                path.append(observation[AGENT_POS])
                observation, _, terminated, truncated, info = env.step(action)
                done = terminated or truncated
                if done:
                    break
        successes.append(info["is_success"])
        ends.append([round(float(x), 1) for x in observation[AGENT_POS][:2]])
        if info["is_success"]:
            ways.append(way_of(np.array(path)))
    return {
        "task": task,
        "loss": loss,
        "fractions": fractions,
        "demonstrations": n_demonstrations,
        "demonstrated": np.bincount(
            [way_of(states) for states, _ in episodes], minlength=spec.n_ways
        ).tolist(),
        "success": float(np.mean(successes)),
        "taken": np.bincount(np.array(ways, dtype=int), minlength=spec.n_ways).tolist(),
        "ends_of_failures": [end for end, success in zip(ends, successes, strict=True) if not success],
    }


def main() -> None:
    torch.set_num_threads(1)
    rows = []
    for setting in SETTINGS:
        rows.append(run(*setting))
        RESULT.write_text("[\n" + ",\n".join(json.dumps(row) for row in rows) + "\n]\n")


if __name__ == "__main__":
    main()
