"""`--dataset.image_transforms.*` on the images that T reads itself."""

import numpy as np
import pytest
import torch
from lerobot.configs import DatasetConfig, FeatureType, NormalizationMode, PolicyFeature
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.transforms import ImageTransforms, ImageTransformsConfig

from lerobot_agpd.replay.demonstrations import DemonstrationFrames
from lerobot_agpd.replay.episode import Episode, EpisodeRecord, EpisodeSpec
from lerobot_agpd.replay.journal import EpisodeJournal
from lerobot_agpd.replay.replay import FRAME_INDEX, Replay
from lerobot_agpd.run import RunInfo

IMAGE, STATE = "observation.image", "observation.state"
SHAPE = (3, 4, 6)
FEATURES = {
    IMAGE: {"dtype": "image", "shape": (4, 6, 3), "names": ["height", "width", "channels"]},
    STATE: {"dtype": "float32", "shape": (1,), "names": None},
    "action": {"dtype": "float32", "shape": (1,), "names": None},
}
DEMONSTRATED, COLLECTED = (0, 1, 2, 3), (200, 201)  # the value of every pixel, and the state


def pixels(values) -> np.ndarray:
    return np.stack([np.full((4, 6, 3), value, dtype=np.uint8) for value in values])


def column(values) -> np.ndarray:
    return np.array(values, dtype=np.float32)[:, None]


@pytest.fixture(scope="module")
def demonstrations(tmp_path_factory) -> LeRobotDataset:
    root = tmp_path_factory.mktemp("data") / "images"
    dataset = LeRobotDataset.create("local/images", fps=10, features=FEATURES, root=root, use_videos=False)
    for value, image in zip(DEMONSTRATED, pixels(DEMONSTRATED), strict=True):
        vector = np.array([value], dtype=np.float32)
        dataset.add_frame({IMAGE: image, STATE: vector, "action": vector, "task": "look"})
    dataset.save_episode()
    dataset.finalize()
    return LeRobotDataset("local/images", root=root)


@pytest.fixture(scope="module")
def collected(demonstrations, tmp_path_factory):
    journal = EpisodeJournal(tmp_path_factory.mktemp("journal"))
    journal.begin(demonstrations.meta, {})
    observations = {IMAGE: pixels(COLLECTED), STATE: column(COLLECTED)}
    rewards = np.zeros(len(COLLECTED), dtype=np.float32)
    episode = Episode(EpisodeSpec(0, 0, 0.0), "look", observations, column(COLLECTED), rewards, None)
    record = EpisodeRecord(0, 0, 0.0, len(COLLECTED), 0.0, None, True, False, True)
    journal.append(0, 0, episode, record)
    return journal.kept(0)


class Negative:
    """A transform that is easily recognized; notes the shapes it is given."""

    def __init__(self):
        self.shapes = []

    def __call__(self, image):
        self.shapes.append(tuple(image.shape))
        return 1 - image


@pytest.fixture
def make_replay(demonstrations, collected):
    """T without normalization and the loader's batch of all demonstrations, delivered as pixel value 0.25."""

    def build(make_config, transform, **options):
        config = make_config(
            input_features={
                IMAGE: PolicyFeature(FeatureType.VISUAL, SHAPE),
                STATE: PolicyFeature(FeatureType.STATE, (1,)),
            },
            output_features={"action": PolicyFeature(FeatureType.ACTION, (1,))},
            normalization_mapping=dict.fromkeys(("VISUAL", "STATE", "ACTION"), NormalizationMode.IDENTITY),
            **options,
        )
        replay = Replay(DemonstrationFrames(config, demonstrations.meta, {}), config, 0.5, transform)
        batch = {
            "index": torch.arange(4).repeat(8),
            "episode_index": torch.zeros(32, dtype=torch.long),
            IMAGE: torch.full((32, *SHAPE), 0.25),
            STATE: torch.arange(4.0).repeat(8)[:, None],
            "action": torch.arange(4.0).repeat(8)[:, None],
        }
        replay.observe(batch)
        replay.extend(collected)
        return replay, batch

    return build


def generator():
    return torch.Generator().manual_seed(0)


def values(images):
    """The pixel value of images (..., C, H, W) that have only one."""
    flat = images.flatten(-3)
    assert torch.equal(flat.min(-1).values, flat.max(-1).values)
    return (flat[..., 0] * 255).round().long()


def test_collected_frames_are_transformed_and_the_loaders_are_left_alone(make_replay, agpd_config):
    transform = Negative()
    replay, batch = make_replay(agpd_config, transform)
    drawn = replay.train_batch(batch, generator())
    exchanged = drawn[FRAME_INDEX] >= len(DEMONSTRATED)
    assert 0 < exchanged.sum() < 32
    assert torch.equal(drawn[IMAGE][~exchanged], batch[IMAGE][~exchanged])
    assert torch.equal(values(drawn[IMAGE][exchanged]), 255 - drawn[STATE][exchanged, 0].long())
    assert transform.shapes == [SHAPE] * int(exchanged.sum())


def test_a_history_is_transformed_as_one(make_replay, agpd_diffusion_config):
    transform = Negative()
    replay, batch = make_replay(agpd_diffusion_config, transform, drop_n_last_frames=0)
    drawn = replay.train_batch(batch, generator())
    assert (drawn[FRAME_INDEX] >= len(DEMONSTRATED)).any() and (drawn[FRAME_INDEX] < len(DEMONSTRATED)).any()
    assert drawn[IMAGE].shape == (32, 2, *SHAPE)
    assert torch.equal(values(drawn[IMAGE]), 255 - drawn[STATE][..., 0].long())
    assert transform.shapes == [(2, *SHAPE)] * 32, "one draw for a history, as in LeRobot's loader"


def test_held_out_batches_and_the_teachers_histories_are_not_transformed(make_replay, agpd_diffusion_config):
    replay, batch = make_replay(agpd_diffusion_config, Negative())
    drawn = replay.eval_batch(batch)
    assert torch.equal(values(drawn[IMAGE]), drawn[STATE][..., 0].long())
    history = replay.history(torch.tensor([2, 5]), [IMAGE], 2)[IMAGE]
    assert values(history).tolist() == [[1, 2], [200, 201]]


def test_a_demonstration_frame_is_decoded_once_for_all_rows(make_replay, agpd_diffusion_config, monkeypatch):
    replay, batch = make_replay(agpd_diffusion_config, None, drop_n_last_frames=0)
    decoded, read = [], LeRobotDataset.__getitem__
    monkeypatch.setattr(
        LeRobotDataset, "__getitem__", lambda self, index: decoded.append(index) or read(self, index)
    )
    drawn = replay.eval_batch(batch)
    assert sorted(decoded) == [0, 1, 2, 3]
    assert torch.equal(values(drawn[IMAGE]), drawn[STATE][..., 0].long())


def test_the_runs_transforms_are_found(agpd_config):
    def transforms(enable):
        images = ImageTransformsConfig(enable=enable, max_num_transforms=1)
        dataset = DatasetConfig(repo_id="a/b", image_transforms=images)
        return RunInfo.from_train_config(TrainPipelineConfig(dataset, policy=agpd_config())).image_transforms

    assert transforms(False) is None
    found = transforms(True)
    assert isinstance(found, ImageTransforms) and found.tf.n_subset == 1
    assert found(torch.rand(2, *SHAPE)).shape == (2, *SHAPE)
