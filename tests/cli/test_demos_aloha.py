"""`lerobot-agpd-demos` on ALOHA's cube transfer: images recorded, states acted on."""

import json
import sys

import numpy as np
import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_agpd.cli import demos
from lerobot_agpd.envs.aloha import AlohaStateEnvConfig

pytest.importorskip("gym_aloha")
pytestmark = pytest.mark.slow

ENV_OPTIONS = {"observation_height": 12, "observation_width": 16, "shadows": False}


@pytest.fixture(scope="module")
def recorded(rendering, tmp_path_factory) -> LeRobotDataset:
    """An expert's and an operator's episode, recorded through the console command."""
    root = tmp_path_factory.mktemp("demos") / "aloha"
    argv = ["lerobot-agpd-demos", "--env.type=aloha_state", "--env.task=AlohaTransferCube-v0"]
    argv += [
        "--env.obs_type=pixels_agent_pos",
        *(f"--env.{key}={value}" for key, value in ENV_OPTIONS.items()),
    ]
    argv += ["--episodes=2", "--skill=[1,0.75]", "--seed=20", f"--root={root}"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", argv)
        demos.main()
    return LeRobotDataset("local/demos", root=root)


def test_dataset_holds_images_and_joints_but_not_the_cube(recorded):
    frame = recorded[0]
    assert frame["observation.images.top"].shape == (3, 12, 16)
    assert frame["observation.images.top"].std() > 0.02
    assert frame["observation.state"].shape == frame["action"].shape == (14,)
    assert "observation.environment_state" not in recorded.features
    assert frame["task"] == "Pick up the cube with the right arm and hand it to the left arm."


def test_episodes_end_with_the_transfer(recorded):
    for episode in range(2):
        frames = [frame for frame in recorded if frame["episode_index"] == episode]
        assert [frame["next.success"].item() for frame in frames] == [False] * (len(frames) - 1) + [True]
        assert [frame["next.reward"].item() for frame in frames][-1] == 4
    assert {recorded[i]["skill"].item() for i in range(len(recorded))} == {1.0, 0.75}


def test_replayed_actions_repeat_the_episodes(recorded):
    report = json.loads((recorded.root / demos.REPORT_PATH).read_text())
    env = AlohaStateEnvConfig(obs_type="environment_state_agent_pos").make_single()
    frames = [recorded[i] for i in range(len(recorded))]
    for episode, seed in enumerate(report["seeds"]):
        observation, _ = env.reset(seed=seed)
        for frame in (frame for frame in frames if frame["episode_index"] == episode):
            np.testing.assert_array_equal(observation["agent_pos"], frame["observation.state"])
            observation, reward, terminated, _, _ = env.step(frame["action"].numpy())
            assert reward == frame["next.reward"].item()
            assert terminated == frame["next.done"].item()
        assert terminated
