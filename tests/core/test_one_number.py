"""States and actions of one number, which LeRobot's dataset delivers without a dimension."""

import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_agpd.config import AdversaryConfig, CollectConfig
from lerobot_agpd.policies.agpd.modeling_agpd import AGPDPolicy

N_FRAMES = 8


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    number = {"dtype": "float32", "shape": (1,), "names": None}
    features = dict.fromkeys(("observation.state", "observation.environment_state", "action"), number)
    root = tmp_path_factory.mktemp("data") / "numbers"
    empty = LeRobotDataset.create("local/numbers", fps=10, features=features, root=root, use_videos=False)
    for episode in range(2):
        for step in range(N_FRAMES):
            value = np.array([episode + step / N_FRAMES], dtype=np.float32)
            state = {"observation.state": value, "observation.environment_state": 2 * value}
            empty.add_frame({**state, "action": -value, "task": "count"})
        empty.save_episode()
    empty.finalize()
    return LeRobotDataset("local/numbers", root=root)


@pytest.fixture
def config(agpd_config):
    return agpd_config(
        input_features={
            "observation.state": PolicyFeature(FeatureType.STATE, (1,)),
            "observation.environment_state": PolicyFeature(FeatureType.ENV, (1,)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (1,))},
        collect=CollectConfig(every=0),
        adversary=AdversaryConfig(weight=0),
    )


def test_it_trains_on_the_demonstrated_numbers(build, loop_batch, config, dataset):
    policy = build(config, AGPDPolicy, dataset)
    batch = loop_batch(config, [0, 3, 9], dataset)
    loss, _ = policy.forward(batch)
    assert torch.isfinite(loss)
    chunk = policy.agpd.train_batch(batch)["action"]  # (B, H, 1), normalized
    mean, std = (float(dataset.meta.stats["action"][name][0]) for name in ("mean", "std"))
    expected = [-(episode + step / N_FRAMES) for episode, step in ((0, 0), (0, 3), (1, 1))]
    assert chunk[:, 0, 0].tolist() == pytest.approx([(value - mean) / std for value in expected], abs=1e-3)
