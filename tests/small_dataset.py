"""Small LeRobotDatasets of vectors."""

import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

LENGTHS = (5, 1, 7)
FPS = 10
FEATURES = {
    "observation.state": {"dtype": "float32", "shape": (2,), "names": None},
    "observation.environment_state": {"dtype": "float32", "shape": (3,), "names": None},
    "action": {"dtype": "float32", "shape": (2,), "names": None},
    "next.reward": {"dtype": "float32", "shape": (1,), "names": None},
    "next.success": {"dtype": "bool", "shape": (1,), "names": None},
    "next.done": {"dtype": "bool", "shape": (1,), "names": None},
}


def create_dataset(root) -> LeRobotDataset:
    """An empty dataset."""
    return LeRobotDataset.create(
        "local/small", fps=FPS, features=FEATURES, root=root, robot_type="none", use_videos=False
    )


def make_dataset(root, lengths=LENGTHS, seed=0, gripper=None) -> LeRobotDataset:
    """Episodes of random frames; `observation.state` is (episode, step), so that every frame is known by it.

    Given `gripper`, the second dimension of the action always has that value.
    """
    rng = np.random.default_rng(seed)
    dataset = create_dataset(root)
    for episode, length in enumerate(lengths):
        for step in range(length):
            last = step == length - 1
            environment_state, action = rng.normal(5, 3, 3), rng.normal(-2, 4, 2)
            action[1] = action[1] if gripper is None else gripper
            dataset.add_frame(
                {
                    "observation.state": np.array([episode, step], dtype=np.float32),
                    "observation.environment_state": environment_state.astype(np.float32),
                    "action": action.astype(np.float32),
                    "next.reward": np.array([step], dtype=np.float32),
                    "next.success": np.array([last]),
                    "next.done": np.array([last]),
                    "task": "a small task",
                }
            )
        dataset.save_episode()
    dataset.finalize()
    return LeRobotDataset("local/small", root=root)
