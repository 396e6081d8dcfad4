"""The same command line distills from ALOHA's cameras: a smoke run with LeRobot's own diffusion policy as teacher."""

from pathlib import Path

import numpy as np
import pytest
from commands import QUIET, TINY_STUDENT, dataset_flags, last_checkpoint, records, reports, run
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.envs import make_env
from lerobot.envs.configs import AlohaEnv

pytestmark = pytest.mark.slow

N_STEPS = 12


@pytest.fixture
def aloha_demos(tmp_path: Path) -> Path:
    """Two short episodes of small random motions, in the real environment."""
    root = tmp_path / "demos"
    envs = make_env(AlohaEnv(task="AlohaTransferCube-v0", episode_length=N_STEPS), n_envs=1)["aloha"][0]
    vector = {"dtype": "float32", "shape": (14,), "names": None}
    camera = {"dtype": "image", "shape": (480, 640, 3), "names": ["height", "width", "channel"]}
    features = {"observation.state": vector, "action": vector, "observation.images.top": camera}
    dataset = LeRobotDataset.create("local/test", fps=50, features=features, root=root, use_videos=False)
    rng = np.random.default_rng(0)
    for episode in range(2):
        observation, _ = envs.reset(seed=[episode])
        for _ in range(N_STEPS):
            state = observation["agent_pos"][0].astype(np.float32)
            action = state + rng.normal(0, 0.02, 14).astype(np.float32)
            top = observation["pixels"]["top"][0]
            dataset.add_frame(
                {
                    "observation.state": state,
                    "action": action,
                    "observation.images.top": top,
                    "task": "transfer",
                }
            )
            observation, *_ = envs.step(action[None])
        dataset.save_episode()
    dataset.finalize()
    envs.close()
    return root


def test_distillation_from_cameras(aloha_demos: Path, tmp_path: Path) -> None:
    network = [
        "--policy.pretrained_backbone_weights=null",
        "--policy.device=cpu",
        "--policy.push_to_hub=false",
    ]
    teacher = tmp_path / "teacher"
    run(
        "lerobot-train",
        "--policy.type=diffusion",
        *network,
        "--policy.resize_shape=[96,96]",
        "--policy.down_dims=[16,32]",
        "--policy.use_group_norm=true",
        "--policy.horizon=16",
        "--policy.n_action_steps=8",
        "--policy.num_inference_steps=5",
        "--batch_size=2",
        *QUIET,
        *dataset_flags(aloha_demos),
        "--steps=2",
        f"--output_dir={teacher}",
    )
    output = tmp_path / "student"
    run(
        "lerobot-train",
        *TINY_STUDENT,
        *network,
        "--batch_size=2",
        *dataset_flags(aloha_demos),
        f"--policy.teacher.path={last_checkpoint(teacher)}",
        "--env.type=aloha",
        "--env.task=AlohaTransferCube-v0",
        f"--env.episode_length={N_STEPS}",
        "--policy.collect.warmup=1",
        "--policy.collect.rounds=1",
        "--policy.collect.episodes=2",
        "--policy.collect.n_envs=2",
        "--policy.collect.diagnostics=false",
        "--policy.adversary.start=1",
        "--steps=3",
        f"--output_dir={output}",
    )
    assert [report["total"]["generated"] for report in reports(output)] == [2]
    assert [record["length"] for record in records(output, 0)] == [N_STEPS, N_STEPS]
    assert (output / "checkpoints" / "000003" / "pretrained_model" / "model.safetensors").is_file()
