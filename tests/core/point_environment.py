"""A point mass that is to reach the origin, its teacher in closed form, and demonstrations of it.

Features have the names and shapes of the small dataset in tests/conftest.py.
"""

from dataclasses import dataclass, field

import gymnasium as gym
import numpy as np
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.envs import EnvConfig
from toy_policies import NoisyTeacher

NAME = "lerobot_agpd_tests/Point-v0"
FEATURE_NAMES = {"agent_pos": "observation.state", "environment_state": "observation.environment_state"}
FPS, LIMIT, REACHED, GAIN = 10, 12, 0.25, 0.3
EPISODE_LENGTH = 4  # of the teacher alone, two steps per decision: its distance is 1, .7, .4, .28, .16


class Point(gym.Env):
    """Moves by its actions; starts at distance 1, succeeds where the origin is near."""

    observation_space = gym.spaces.Dict(
        agent_pos=gym.spaces.Box(-np.inf, np.inf, (2,), np.float32),
        environment_state=gym.spaces.Box(-np.inf, np.inf, (3,), np.float32),
    )
    action_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)
    task_description = "reach the origin"

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        angle = self.np_random.uniform(0, 2 * np.pi)
        self.position = np.array([np.cos(angle), np.sin(angle)])
        return self.observation(), {"is_success": False}

    def observation(self):
        distance = np.linalg.norm(self.position)
        direction = np.array([*(self.position / max(distance, 1e-6)), distance])
        return {
            "agent_pos": self.position.astype(np.float32),
            "environment_state": direction.astype(np.float32),
        }

    def step(self, action):
        self.position = self.position + np.asarray(action, dtype=np.float64)
        distance = float(np.linalg.norm(self.position))
        is_success = distance < REACHED
        return self.observation(), 1 - distance, is_success, False, {"is_success": is_success}


if NAME not in gym.registry:
    gym.register(NAME, entry_point=Point, max_episode_steps=LIMIT)


@EnvConfig.register_subclass("agpd_test_point")
@dataclass
class PointEnv(EnvConfig):
    """`--env.type=agpd_test_point`."""

    task: str | None = "Point-v0"
    fps: int = FPS
    features: dict[str, PolicyFeature] = field(
        default_factory=lambda: {
            "action": PolicyFeature(FeatureType.ACTION, (2,)),
            "agent_pos": PolicyFeature(FeatureType.STATE, (2,)),
            "environment_state": PolicyFeature(FeatureType.ENV, (3,)),
        }
    )
    features_map: dict[str, str] = field(default_factory=lambda: {"action": "action", **FEATURE_NAMES})

    @property
    def package_name(self):
        return NAME.split("/")[0]

    @property
    def gym_kwargs(self):
        return {}


class PointTeacher(NoisyTeacher):
    """Goes toward the origin with every step of its chunk."""

    def __init__(self, spread=0.01):
        super().__init__(spread, action_dim=2)

    def mean_action(self, state):
        return -GAIN * state


def demonstrate(dataset: LeRobotDataset, n_episodes: int, env=None, names=FEATURE_NAMES) -> LeRobotDataset:
    """Record episodes of the teacher's law into an empty dataset: those of its features that the environment shows."""
    env = env or Point()
    for seed in range(n_episodes):
        observation, _ = env.reset(seed=seed)
        done = False
        while not done:
            action = (-GAIN * env.position).astype(np.float32)
            frame = {name: observation[key] for key, name in names.items() if name in dataset.features}
            frame |= {"action": action, "task": Point.task_description}
            observation, reward, done, _, _ = env.step(action)
            outcome = {"next.reward": np.float32(reward), "next.success": done, "next.done": done}
            dataset.add_frame({**frame, **{key: np.array([value]) for key, value in outcome.items()}})
        dataset.save_episode()
    dataset.finalize()
    return LeRobotDataset(dataset.repo_id, root=dataset.root)


def teacher_weights(teacher) -> torch.Tensor:
    """All weights of a teacher's policy, copied."""
    return torch.cat([value.detach().flatten().clone() for value in teacher.policy.state_dict().values()])
