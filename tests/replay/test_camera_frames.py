"""Camera frames of T with random access."""

import numpy as np
import pytest
import torch

from lerobot_agpd.replay.camera_frames import CameraFrames
from lerobot_agpd.replay.frames import FrameTable

CAMERAS = {"observation.images.front": (6, 8, 3), "observation.images.side": (4, 4, 3)}
LENGTHS, COLLECTED = (5, 2), (3, 4)
N_DEMONSTRATED = sum(LENGTHS)


class Collected:
    """What CameraFrames needs of a stored episode."""

    cameras = tuple(CAMERAS)

    def __init__(self, number, length):
        rng = np.random.default_rng(number)
        self.frames = {
            key: rng.integers(256, size=(length, *shape), dtype=np.uint8) for key, shape in CAMERAS.items()
        }
        self.read = 0

    def column(self, key):
        self.read += 1
        return self.frames[key]


@pytest.fixture
def recorded():
    """All frames of the demonstrations."""
    rng = np.random.default_rng(100)
    return {
        key: rng.integers(256, size=(N_DEMONSTRATED, *shape), dtype=np.uint8)
        for key, shape in CAMERAS.items()
    }


@pytest.fixture
def build(recorded):
    def build(**options):
        table, decoded = FrameTable({"x": torch.zeros(N_DEMONSTRATED, 1)}, LENGTHS), []

        def decode(index):
            decoded.append(index)
            frames = {key: torch.from_numpy(values[index]) for key, values in recorded.items()}
            return {key: frame.permute(2, 0, 1).float() / 255 for key, frame in frames.items()}

        frames, episodes = CameraFrames(table, decode, **options), []
        for number, length in enumerate(COLLECTED):
            table.append({"x": torch.zeros(length, 1)}, [length])
            episodes.append(Collected(number, length))
            frames.append(episodes[-1])
        return frames, decoded, episodes

    return build


@pytest.mark.parametrize("memory_limit", [0, 500, 2**20])
def test_every_frame_is_itself_in_memory_and_mapped(build, recorded, memory_limit):
    frames, _, episodes = build(memory_limit=memory_limit)
    index = torch.randperm(
        N_DEMONSTRATED + sum(COLLECTED), generator=torch.Generator().manual_seed(0)
    ).repeat(2)
    images = frames.read(index, list(CAMERAS))
    assert frames.nbytes <= memory_limit
    for key, (height, width, channels) in CAMERAS.items():
        everything = np.concatenate([recorded[key], *(episode.frames[key] for episode in episodes)])
        assert images[key].dtype == torch.uint8 and images[key].shape == (len(index), channels, height, width)
        np.testing.assert_array_equal(images[key].permute(0, 2, 3, 1), everything[index])


def test_a_frame_is_decoded_once_for_all_cameras(build):
    frames, decoded, _ = build()
    frames.read(torch.tensor([3, 1, 3]), ["observation.images.front"])
    frames.read(torch.tensor([1, 3, 6]), ["observation.images.side"])
    assert sorted(decoded) == [1, 3, 6]


def test_collected_frames_are_read_once_while_there_is_room(build):
    frames, _, episodes = build()
    index = torch.arange(N_DEMONSTRATED, N_DEMONSTRATED + sum(COLLECTED))
    for _ in range(3):
        frames.read(index, list(CAMERAS))
    assert [episode.read for episode in episodes] == [len(CAMERAS)] * len(COLLECTED)
    n_bytes = sum(np.prod(shape) for shape in CAMERAS.values())
    assert frames.nbytes == (sum(COLLECTED) + 0 * N_DEMONSTRATED) * n_bytes
    frames.read(torch.tensor([0]), list(CAMERAS))
    assert frames.nbytes == (sum(COLLECTED) + N_DEMONSTRATED) * n_bytes


def test_depth_stays_what_the_dataset_delivers(recorded):
    depth = torch.rand(N_DEMONSTRATED, 1, 4, 4) * 3
    table = FrameTable({"x": torch.zeros(N_DEMONSTRATED, 1)}, LENGTHS)
    frames = CameraFrames(table, lambda index: {"depth": depth[index]}, depth_keys=["depth"])
    assert torch.equal(frames.read(torch.tensor([4, 0]), ["depth"])["depth"], depth[[4, 0]])
