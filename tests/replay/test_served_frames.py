"""Items that the loader gets from memory are LeRobotDataset's own."""

import pickle

import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_agpd.replay.served_frames import serve_from_memory


def copy_of(demonstrations, **options) -> LeRobotDataset:
    return LeRobotDataset(demonstrations.repo_id, root=demonstrations.root, **options)


@pytest.mark.parametrize("episodes", [None, [2, 0]])
@pytest.mark.parametrize("pickled", [False, True])
def test_a_loader_delivers_the_same_batches(demonstrations, episodes, pickled):
    """Also after the way to a worker process."""
    theirs, ours = (copy_of(demonstrations, episodes=episodes) for _ in range(2))
    serve_from_memory(ours)
    ours = pickle.loads(pickle.dumps(ours)) if pickled else ours
    assert ours.__getitems__([1, 0])[0]["index"] == theirs[1]["index"]
    loaders = [torch.utils.data.DataLoader(dataset, batch_size=4) for dataset in (ours, theirs)]
    for batch, expected in zip(*loaders, strict=True):
        assert list(batch) == list(expected)
        for key, value in expected.items():
            if isinstance(value, torch.Tensor):
                assert torch.equal(batch[key], value) and batch[key].dtype == value.dtype, key
            else:
                assert batch[key] == value


def test_a_loader_that_delivers_chunks_stays_as_it_is(demonstrations):
    dataset = copy_of(demonstrations, delta_timestamps={"action": [0.0, 1 / demonstrations.fps]})
    serve_from_memory(dataset)
    assert not hasattr(dataset, "__getitems__")
