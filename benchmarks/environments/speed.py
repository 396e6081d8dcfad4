"""Control steps per second of the environment types, on one core: speed.json beside this file.

Process time, resets left out. Actions are random; ALOHA, whose simulation breaks down under those, stays where it is. It is
measured in turns with LeRobot's own type, at that one's image size, and given as a ratio, too.

usage: MUJOCO_GL=egl python benchmarks/environments/speed.py
"""

import importlib
import json
import statistics
import time
from pathlib import Path

import gymnasium as gym
from lerobot.envs.configs import AlohaEnv
from rich.progress import track

from lerobot_agpd.envs.aloha import AlohaStateEnvConfig
from lerobot_agpd.envs.gymnasium_robotics import GymnasiumRoboticsEnv
from lerobot_agpd.envs.robomimic import RobomimicEnvConfig

RESULT = Path(__file__).parent / "speed.json"
REPETITIONS = 5
DOOR = "AdroitHandDoor-v1"
OURS, THEIRS = (f"{name}, pixels_agent_pos, 640x480" for name in ("aloha_state", "LeRobot's aloha"))


def lerobots_aloha() -> gym.Env:
    """As LeRobot builds it: gym_aloha's, 640x480."""
    config = AlohaEnv()
    importlib.import_module(config.package_name)
    return gym.make(config.gym_id, disable_env_checker=True, **config.gym_kwargs)


def environments() -> dict[str, tuple]:
    """Name to factory and number of steps per repetition."""
    pixels = {"obs_type": "pixels_agent_pos"}
    aloha = {"observation_height": 480, "observation_width": 640, **pixels}
    return {
        "FetchPickAndPlace-v4, state": (GymnasiumRoboticsEnv().make_single, 50),
        "FetchPickAndPlace-v4, 96x96": (GymnasiumRoboticsEnv(**pixels).make_single, 20),
        "AdroitHandDoor-v1, 96x96": (GymnasiumRoboticsEnv(task=DOOR, **pixels).make_single, 20),
        "AdroitHandDoor-v1, 96x96, no shadows": (
            GymnasiumRoboticsEnv(task=DOOR, **pixels, shadows=False).make_single,
            20,
        ),
        "lift, state": (RobomimicEnvConfig(task="lift").make_single, 30),
        "lift, two cameras 84x84": (RobomimicEnvConfig(task="lift", **pixels).make_single, 5),
        "can, state": (RobomimicEnvConfig(task="can").make_single, 30),
        "square, state": (RobomimicEnvConfig(task="square").make_single, 30),
        "transport, state": (RobomimicEnvConfig(task="transport").make_single, 20),
        "tool_hang, state": (RobomimicEnvConfig(task="tool_hang").make_single, 30),
        "aloha_state, state": (AlohaStateEnvConfig().make_single, 100),
        "aloha_state, pixels_agent_pos, 320x240": (AlohaStateEnvConfig(**pixels).make_single, 10),
        "aloha_state, pixels_agent_pos, 320x240, no shadows": (
            AlohaStateEnvConfig(**pixels, shadows=False).make_single,
            20,
        ),
        OURS: (AlohaStateEnvConfig(**aloha).make_single, 5),
        THEIRS: (lerobots_aloha, 5),
    }


def seconds_per_step(env: gym.Env, n_steps: int, seed: int) -> float:
    """Process time of a step, its image included."""
    observation, _ = env.reset(seed=seed)
    env.action_space.seed(seed)
    actions = [env.action_space.sample() for _ in range(n_steps)]
    if observation["agent_pos"].shape == env.action_space.shape:  # ALOHA: joint targets
        actions = [observation["agent_pos"]] * n_steps
    begin = time.process_time()
    for action in actions:
        env.step(action)
    return (time.process_time() - begin) / n_steps


def main() -> None:
    built = {name: (make(), n_steps) for name, (make, n_steps) in environments().items()}
    measured: dict[str, list[float]] = {name: [] for name in built}
    for repetition in track(range(REPETITIONS + 1), "repetitions"):  # the first one warms up
        for name, (env, n_steps) in built.items():
            measured[name].append(seconds_per_step(env, n_steps, repetition))
    rows = {
        name: {
            "steps_per_second": 1 / statistics.median(times[1:]),
            "least": 1 / max(times[1:]),
            "most": 1 / min(times[1:]),
        }
        for name, times in measured.items()
    }
    ratios = [theirs / ours for ours, theirs in zip(measured[OURS], measured[THEIRS], strict=True)]
    content = {"rows": rows, "aloha_ratio": statistics.median(ratios[1:])}
    RESULT.write_text(json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    main()
