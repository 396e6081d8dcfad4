"""What a deterministic student makes of a Panda's demonstrations that know several ways: lift_any.json beside this file.

As `average.py`, with robot and cubes for the network's input. One row per loss, fractions of the ways and number of
demonstrations.

usage: python benchmarks/ways/lift_any.py      (about 20 s of a busy core per row)
"""

import json
import time
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch
from average import CHUNK, EPISODES, EXECUTED, FIRST_SEED, LOSSES, train

from lerobot_agpd.envs.base import AGENT_POS, ENVIRONMENT_STATE
from lerobot_agpd.envs.experts.lift_any import EXPERTS
from lerobot_agpd.envs.experts.ways import WaysExpert
from lerobot_agpd.envs.lift_tasks import TASKS
from lerobot_agpd.envs.robosuite_ways import RobosuiteWaysEnv

RESULT = Path(__file__).parent / "lift_any.json"

SETTINGS = [
    ("LiftAny-v0", "L1", None, 60),
    ("LiftAny-v0", "L2", None, 60),
    ("LiftAny-v0", "L1", (0.0, 0.0, 1.0), 60),
    ("LiftAny-v0", "L1", None, 20),
    ("LiftAny-v0", "L1", (0.2, 0.2, 0.6), 60),
]
"""Task, loss, fractions of the ways (None: all alike), demonstrations."""


def demonstrate(env: gym.Env, expert: WaysExpert, seed: int) -> tuple[np.ndarray, np.ndarray, bool]:
    """States (T, 18) of one episode, the chunks (T, CHUNK, 7) that follow, the last action repeated, and its success."""
    follower = expert.for_episode(np.random.default_rng([7, seed]))
    env.reset(seed=seed)
    states, actions, done = [], [], False
    while not done:
        observation = env.unwrapped.state
        states.append(np.concatenate([observation[AGENT_POS], observation[ENVIRONMENT_STATE]]))
        actions.append(follower(observation))
        _, _, terminated, truncated, info = env.step(actions[-1])
        done = terminated or truncated
    padded = np.array(actions + actions[-1:] * CHUNK)
    chunks = np.stack([padded[i : i + CHUNK] for i in range(len(actions))])
    return np.array(states), chunks, info["is_success"]


def play(env: gym.Env, predict, seed: int) -> tuple[np.ndarray, bool]:
    """States (T, 18) of an episode of the student, without the last, and whether it succeeded."""
    _, info = env.reset(seed=seed)
    path, done = [], False
    while not done:
        observation = env.unwrapped.state
        state = np.concatenate([observation[AGENT_POS], observation[ENVIRONMENT_STATE]])
        for action in predict(state)[:EXECUTED]:
            observation = env.unwrapped.state
            path.append(np.concatenate([observation[AGENT_POS], observation[ENVIRONMENT_STATE]]))
            _, _, terminated, truncated, info = env.step(action)
            done = terminated or truncated
            if done:
                break
    return np.array(path), info["is_success"]


def run(task: str, loss: str, fractions: tuple[float, ...] | None, n_demonstrations: int) -> dict:
    """Train and evaluate one student."""
    env, spec = RobosuiteWaysEnv(task=task).make_single(), TASKS[task]
    robot = spec.agent_pos_dim
    way_of = lambda states: spec.way_of(states[:, :robot], states[:, robot:])  # noqa: E731
    expert = EXPERTS[task] if fractions is None else EXPERTS[task].with_ways(fractions)
    begin = time.process_time()
    attempts = [demonstrate(env, expert, seed) for seed in range(n_demonstrations)]
    seconds = time.process_time() - begin
    episodes = [(states, chunks) for states, chunks, success in attempts if success]
    states = torch.tensor(np.concatenate([states for states, _ in episodes]))
    chunks = torch.tensor(np.concatenate([chunks for _, chunks in episodes])).flatten(1)
    mean, std = (states.mean(0), chunks.mean(0)), (states.std(0), chunks.std(0))
    network = train((states - mean[0]) / std[0], (chunks - mean[1]) / std[1], LOSSES[loss])

    def predict(state: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            chunk = network((torch.tensor(state) - mean[0]) / std[0]) * std[1] + mean[1]
        return chunk.view(CHUNK, -1).clamp(-1, 1).numpy()

    outcomes = [play(env, predict, seed) for seed in range(FIRST_SEED, FIRST_SEED + EPISODES)]
    ways = [way_of(path) for path, success in outcomes if success]
    lowest = [path[path[:, 2].argmin(), :3] for path, success in outcomes if not success]
    return {
        "task": task,
        "loss": loss,
        "fractions": fractions,
        "demonstrations": n_demonstrations,
        "failed_demonstrations": n_demonstrations - len(episodes),
        "steps_per_demonstration": len(states) / len(episodes),
        "steps_per_second": sum(len(states) for states, _, _ in attempts) / seconds,
        "demonstrated": np.bincount(
            [way_of(states) for states, _ in episodes], minlength=spec.n_ways
        ).tolist(),
        "success": float(np.mean([success for _, success in outcomes])),
        "taken": np.bincount(np.array(ways, dtype=int), minlength=spec.n_ways).tolist(),
        "lowest_of_failures": [[round(float(x), 2) for x in place] for place in lowest],
    }


def main() -> None:
    torch.set_num_threads(1)
    rows = []
    for setting in SETTINGS:
        rows.append(run(*setting))
        RESULT.write_text("[\n" + ",\n".join(json.dumps(row) for row in rows) + "\n]\n")


if __name__ == "__main__":
    main()
