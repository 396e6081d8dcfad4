"""What a running episode remembers of its observations."""

import weakref

import numpy as np
import torch

from lerobot_agpd.replay.episode import EpisodeSpec
from lerobot_agpd.rollout.running_episode import RunningEpisode
from lerobot_agpd.rollout.strategies import ChunkBatch


def observed(pixels, step) -> dict[str, torch.Tensor]:
    """An image as LeRobot's `preprocess_observation` delivers it, and a state."""
    image = torch.from_numpy(pixels).permute(2, 0, 1).contiguous().float() / 255
    return {"observation.image": image, "observation.state": torch.tensor([0.1, step], dtype=torch.float64)}


def test_pixels_come_back_exactly_and_their_floats_are_let_go():
    every_value = np.arange(256, dtype=np.uint8).reshape(8, 32, 1)
    frames = [
        np.concatenate([every_value, every_value[::-1], every_value + np.uint8(n)], 2) for n in range(4)
    ]
    running, images = RunningEpisode(EpisodeSpec(0, 0, 0.0), n_obs_steps=2), []
    for step, frame in enumerate(frames):
        observation = observed(frame, step)
        images.append(weakref.ref(observation["observation.image"]))
        running.observe(observation)
        running.plan(ChunkBatch(torch.zeros(1, 1, 2), torch.zeros(1), torch.zeros(1)), 0)
        running.record(np.zeros(2), 0.0, None)
    del observation
    assert [image() is not None for image in images] == [False, False, True, True], "the history alone"
    observations = running.finish("a task").observations
    assert observations["observation.image"].dtype == np.uint8
    np.testing.assert_array_equal(observations["observation.image"], np.stack(frames))
    assert observations["observation.state"].dtype == np.float32
    assert observations["observation.state"][:, 1].tolist() == [0, 1, 2, 3]
