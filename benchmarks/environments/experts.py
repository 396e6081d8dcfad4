"""How often scripted experts and operators succeed: experts.json beside this file.

Operators play seed after seed as in `lerobot-agpd-demos`, but a fixed number of seeds instead of until enough succeed.

usage: MUJOCO_GL=egl python benchmarks/environments/experts.py      (a quarter of an hour on one core)
"""

import json
from pathlib import Path

import numpy as np
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import SUCCESS
from rich.progress import track

from lerobot_agpd.envs.aloha import AlohaStateEnvConfig
from lerobot_agpd.envs.demonstrations import play_episode
from lerobot_agpd.envs.experts import make_expert
from lerobot_agpd.envs.gymnasium_robotics import GymnasiumRoboticsEnv
from lerobot_agpd.envs.operators import Operator
from lerobot_agpd.envs.robomimic import RobomimicEnvConfig

RESULT = Path(__file__).parent / "experts.json"
SKILLS = {1.0: 100, 0.75: 50, 0.5: 50, 0.25: 50}
"""Skill to number of seeds."""

ENVIRONMENTS: list[EnvConfig] = [
    *(
        GymnasiumRoboticsEnv(task=task, episode_length=length)
        for task in ("FetchReach-v4", "FetchPush-v4", "FetchPickAndPlace-v4")
        for length in (50, 100)
    ),
    RobomimicEnvConfig(task="lift"),
    RobomimicEnvConfig(task="can"),
    AlohaStateEnvConfig(task="AlohaTransferCube-v0"),
    AlohaStateEnvConfig(task="AlohaTransferCube-v0", episode_length=800),
]


def play(config: EnvConfig, skill: float, n_seeds: int) -> dict:
    """Counts and lengths of the episodes of seeds 0 to n_seeds - 1."""
    env, expert = config.make_single(), make_expert(config)
    episodes = []
    for seed in track(range(n_seeds), f"{config.task}, {config.episode_length} steps, skill {skill:g}"):
        rng = np.random.default_rng([0, seed])
        operator = Operator(expert.for_episode(rng), skill, rng)
        episodes.append(play_episode(env, operator, seed, config.features_map))
    env.close()
    counted = [frames for frames in episodes if frames is not None]
    return {
        "task": config.task,
        "episode_length": config.episode_length,
        "skill": skill,
        "trivial": n_seeds - len(counted),
        "successes": [bool(frames[-1][SUCCESS].item()) for frames in counted],
        "lengths": [len(frames) for frames in counted],
    }


def main() -> None:
    rows = json.loads(RESULT.read_text()) if RESULT.exists() else []
    done = {(row["task"], row["episode_length"], row["skill"]) for row in rows}
    for config in ENVIRONMENTS:
        for skill, n_seeds in SKILLS.items():
            if (config.task, config.episode_length, skill) not in done:
                rows.append(play(config, skill, n_seeds))
                RESULT.write_text(json.dumps(rows) + "\n")


if __name__ == "__main__":
    main()
