"""What a deterministic student makes of demonstrations that know several ways: average*.json beside this file.

No teacher, no rounds: a regression network of the state to a chunk of 16 actions is trained on episodes of the scripted
expert and executes 8 of them per prediction. One row per task, loss, fractions of the ways and number of demonstrations.

usage: python benchmarks/ways/average.py point_maze_ways      (average.json; 10 to 20 s on one free core per row)
       python benchmarks/ways/average.py fetch_ways           (average_fetch.json; 5 to 20 s per row)
"""

import json
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor, nn

from lerobot_agpd.envs.base import AGENT_POS, ENVIRONMENT_STATE, SimulatedEnvConfig
from lerobot_agpd.envs.experts import fetch_ways, point_maze
from lerobot_agpd.envs.experts.base import Observation
from lerobot_agpd.envs.experts.ways import WaysExpert
from lerobot_agpd.envs.fetch_ways import FetchWaysEnv
from lerobot_agpd.envs.point_maze import PointMazeWaysEnv
from lerobot_agpd.envs.ways import WaysTask

CHUNK, EXECUTED = 16, 8
STEPS, BATCH = 1000, 128
EPISODES, FIRST_SEED = 50, 100_000
LOSSES = {"L1": nn.L1Loss(), "L2": nn.MSELoss()}

Setting = tuple[str, str, tuple[float, ...] | None, int]
"""Task, loss, fractions of the ways (None: all alike), demonstrations."""


@dataclass(frozen=True)
class Study:
    """The rows of one environment type.

    Attributes:
        result: file of the rows.
        env: configuration of the environment.
        experts: task to expert.
        inputs: raw keys that the network sees.
        hand: how many numbers of `agent_pos` are the position, and with how many decimals it is reported.
        settings: one per row.
    """

    result: str
    env: type[SimulatedEnvConfig]
    experts: Mapping[str, WaysExpert]
    inputs: tuple[str, ...]
    hand: tuple[int, int]
    settings: tuple[Setting, ...]

    def state(self, observation: Observation) -> np.ndarray:
        """What the network sees of an observation, (D,)."""
        return np.concatenate([observation[key] for key in self.inputs])


STUDIES = {
    "point_maze_ways": Study(
        result="average.json",
        env=PointMazeWaysEnv,
        experts=point_maze.EXPERTS,
        inputs=(AGENT_POS,),
        hand=(2, 1),
        settings=(
            ("ThreeExits-v0", "L1", None, 120),
            ("ThreeExits-v0", "L2", None, 120),
            ("ThreeExits-v0", "L1", (0.0, 0.0, 1.0), 120),
            ("ThreeExits-v0", "L1", (0.2, 0.2, 0.6), 120),
            ("ThreeExits-v0", "L1", None, 20),
            ("TwoWays-v0", "L1", None, 120),
            ("TwoWays-v0", "L2", None, 120),
            ("Chain-v0", "L1", None, 120),
            ("Chain-v0", "L2", None, 120),
        ),
    ),
    "fetch_ways": Study(
        result="average_fetch.json",
        env=FetchWaysEnv,
        experts=fetch_ways.EXPERTS,
        inputs=(AGENT_POS, ENVIRONMENT_STATE),
        hand=(3, 2),
        settings=(
            ("PickAndPlaceAnyPlace-v0", "L1", None, 120),
            ("PickAndPlaceAnyPlace-v0", "L1", (0.0, 0.0, 1.0), 120),
            ("PickAndPlaceAnyPlace-v0", "L1", (0.2, 0.2, 0.6), 120),
            ("PickAndPlaceAnyPlace-v0", "L2", None, 120),
            ("PickAndPlaceAnyPlace-v0", "L1", None, 20),
            ("PickAndPlaceAnyPlace-v0", "L1", (0.0, 1.0, 0.0), 20),
            ("PickAnyBlock-v0", "L1", None, 120),
            ("PickAnyBlock-v0", "L1", (0.0, 0.0, 1.0), 120),
            ("PickAnyBlock-v0", "L1", (0.2, 0.2, 0.6), 120),
            ("PickAnyBlock-v0", "L2", None, 120),
            ("PickAnyBlock-v0", "L1", None, 20),
            ("PickAnyBlock-v0", "L1", (1.0, 0.0, 0.0), 20),
            ("ReachAnyPlace-v0", "L1", None, 120),
            ("ReachAnyPlace-v0", "L2", None, 120),
            ("ReachAnyPlace-v0", "L1", (0.0, 0.0, 1.0), 120),
            ("PushEitherSide-v0", "L1", None, 120),
            ("PushEitherSide-v0", "L2", None, 120),
            ("PushEitherSide-v0", "L1", (0.0, 1.0), 120),
        ),
    ),
}
"""`--env.type` to its rows."""


def demonstrate(env: gym.Env, expert: WaysExpert, seed: int) -> tuple[list[Observation], np.ndarray]:
    """Observations (T) of one episode and the chunks (T, CHUNK, A) that follow, the last action repeated."""
    follower = expert.for_episode(np.random.default_rng([7, seed]))
    env.reset(seed=seed)
    observations, actions, done = [], [], False
    while not done:
        observations.append(env.get_wrapper_attr("state"))
        actions.append(follower(observations[-1]))
        _, _, terminated, truncated, _ = env.step(actions[-1])
        done = terminated or truncated
    padded = np.array(actions + actions[-1:] * CHUNK)
    return observations, np.stack([padded[i : i + CHUNK] for i in range(len(actions))])


def way_of(spec: WaysTask, observations: list[Observation]) -> int:
    """Way that an episode took."""
    return spec.way_of(
        *(np.stack([each[key] for each in observations]) for key in (AGENT_POS, ENVIRONMENT_STATE))
    )


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


def run(
    study: Study, task: str, loss: str, fractions: tuple[float, ...] | None, n_demonstrations: int
) -> dict:
    """Train and evaluate one student."""
    env, spec = study.env(task=task).make_single(), study.env.tasks[task]
    expert = study.experts[task] if fractions is None else study.experts[task].with_ways(fractions)
    episodes = [demonstrate(env, expert, seed) for seed in range(n_demonstrations)]
    states = torch.tensor(np.array([study.state(each) for episode, _ in episodes for each in episode]))
    chunks = torch.tensor(np.concatenate([chunks for _, chunks in episodes])).flatten(1)
    mean, std = (states.mean(0), chunks.mean(0)), (states.std(0).clamp(1e-3), chunks.std(0).clamp(1e-3))
    network = train((states - mean[0]) / std[0], (chunks - mean[1]) / std[1], LOSSES[loss])

    n_position, decimals = study.hand
    successes, ways, ends = [], [], []
    for seed in range(FIRST_SEED, FIRST_SEED + EPISODES):
        observation, info = env.reset(seed=seed)
        path, done = [], False
        while not done:
            with torch.no_grad():
                state = (torch.tensor(study.state(observation)) - mean[0]) / std[0]
                chunk = (network(state) * std[1] + mean[1]).view(CHUNK, -1).clamp(-1, 1).numpy()
            for action in chunk[:EXECUTED]:
                path.append(observation)
                observation, _, terminated, truncated, info = env.step(action)
                done = terminated or truncated
                if done:
                    break
        successes.append(info["is_success"])
        ends.append([round(float(x), decimals) for x in observation[AGENT_POS][:n_position]])
        if info["is_success"]:
            ways.append(way_of(spec, path))
    return {
        "task": task,
        "loss": loss,
        "fractions": fractions,
        "demonstrations": n_demonstrations,
        "demonstrated": np.bincount(
            [way_of(spec, episode) for episode, _ in episodes], minlength=spec.n_ways
        ).tolist(),
        "success": float(np.mean(successes)),
        "taken": np.bincount(np.array(ways, dtype=int), minlength=spec.n_ways).tolist(),
        "ends_of_failures": [end for end, success in zip(ends, successes, strict=True) if not success],
    }


def main() -> None:
    torch.set_num_threads(1)
    study = STUDIES[sys.argv[1]]
    rows = []
    for setting in study.settings:
        rows.append(run(study, *setting))
        (Path(__file__).parent / study.result).write_text(
            "[\n" + ",\n".join(json.dumps(row) for row in rows) + "\n]\n"
        )


if __name__ == "__main__":
    main()
