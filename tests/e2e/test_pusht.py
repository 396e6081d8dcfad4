"""Push-T: asynchronous evaluation, and distillation from pixels."""

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
import torch
from commands import (
    TINY_STUDENT,
    TINY_TEACHER,
    dataset_flags,
    last_checkpoint,
    records,
    reports,
    run,
    run_afresh,
)
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from pusht import N_STEPS, record

from lerobot_agpd.config import CollectConfig, GuidanceConfig
from lerobot_agpd.replay.episode import Episode, EpisodeSpec
from lerobot_agpd.replay.journal import EpisodeJournal
from lerobot_agpd.rollout.report import RoundReport
from lerobot_agpd.rollout.success import classify

pytestmark = pytest.mark.slow

PIXELS = ["--env.type=pusht", "--env.obs_type=pixels_agent_pos", f"--env.episode_length={N_STEPS}"]


def test_cloning_and_asynchronous_evaluation(tmp_path: Path) -> None:
    """The evaluation as in a shell: LeRobot's forkserver workers know gym_pusht only because the plugin preloads it."""
    demos = record(tmp_path / "demos", pixels=False)
    run(
        "lerobot-train",
        *TINY_STUDENT,
        *dataset_flags(demos),
        "--policy.collect.every=0",
        "--policy.adversary.weight=0",
        "--dataset.eval_split=0.25",
        "--eval_steps=5",
        "--steps=10",
        f"--output_dir={tmp_path / 'run'}",
    )
    run_afresh(
        "lerobot-eval",
        f"--policy.path={last_checkpoint(tmp_path / 'run')}",
        "--policy.device=cpu",
        "--env.type=pusht",
        "--env.obs_type=environment_state_agent_pos",
        "--env.episode_length=10",
        "--eval.batch_size=2",
        "--eval.n_episodes=2",
        "--eval.use_async_envs=true",
        f"--output_dir={tmp_path / 'eval'}",
    )
    assert json.loads((tmp_path / "eval" / "eval_info.json").read_text())["overall"]["n_episodes"] == 2


def write_round(root: Path, demos: Path, identity: dict) -> None:
    """A finished round of one kept episode, the first demonstration, as collection leaves it."""
    dataset = LeRobotDataset("local/test", root=demos, episodes=[0])
    frames = [dataset[step] for step in range(N_STEPS)]
    images = [(frame["observation.image"] * 255).round().permute(1, 2, 0).numpy() for frame in frames]
    episode = Episode(
        spec=EpisodeSpec(number=0, seed=1_000_000, strength=0.5),
        task="push",
        observations={
            "observation.state": np.stack([frame["observation.state"].numpy() for frame in frames]),
            "observation.image": np.stack(images).astype(np.uint8),
        },
        actions=np.stack([frame["action"].numpy() for frame in frames]),
        rewards=np.linspace(0, 1, N_STEPS, dtype=np.float32),
        successes=None,
    )
    journal = EpisodeJournal(root)
    journal.begin(dataset.meta, identity)
    journal.append(0, 0, episode, classify(episode, CollectConfig(min_reward=0.9)))
    report = RoundReport.of(journal.records(0), round=0, strength=0.5, next_strength=0.5, step=0)
    journal.finish(0, report.to_json())


def test_distillation_from_pixels(tmp_path: Path) -> None:
    """Images come from the loader for demonstrations and from the journal for collected frames."""
    demos = record(tmp_path / "demos", pixels=True)
    network = ["--policy.pretrained_backbone_weights=null", "--dataset.use_imagenet_stats=false"]
    teacher = tmp_path / "teacher"
    run(
        "lerobot-train",
        *TINY_TEACHER,
        *network,
        "--policy.in_memory=false",
        "--policy.crop_shape=[84,84]",
        "--policy.use_group_norm=true",
        "--batch_size=8",
        "--policy.noise_samples_per_frame=1",
        *dataset_flags(demos),
        "--steps=5",
        f"--output_dir={teacher}",
    )
    rounds = tmp_path / "agpd"
    environment = {"type": "pusht", "task": "PushT-v0"}
    origin = {"environment": environment, "teacher": str(last_checkpoint(teacher)), "seed": 1000}
    settings = {f"guidance.{name}": value for name, value in asdict(GuidanceConfig()).items()}
    settings |= {"representation.type": "action", "collect.min_reward": 0.9, "collect.keep_failures": False}
    write_round(rounds, demos, {"strategy": "guided", **settings, **origin})
    printed = run(
        "lerobot-train",
        *TINY_STUDENT,
        *network,
        *PIXELS,
        *dataset_flags(demos),
        f"--policy.teacher.path={last_checkpoint(teacher)}",
        f"--policy.replay.root={rounds}",
        "--policy.collect.warmup=1",
        "--policy.collect.every=2",
        "--policy.collect.rounds=2",
        "--policy.collect.episodes=3",
        "--policy.collect.min_reward=0.9",
        "--policy.replay.collected_fraction=0.5",
        "--dataset.image_transforms.enable=true",
        "--policy.adversary.start=2",
        "--batch_size=8",
        "--log_freq=1",
        "--steps=5",
        f"--output_dir={tmp_path / 'run'}",
    )
    assert "collected_fraction:0.500" in printed
    (_, report) = reports(tmp_path)
    assert report["total"]["generated"] == 3
    assert [record["length"] for record in records(tmp_path, 1)] == [N_STEPS] * 3
    merged = LeRobotDataset("x", root=rounds / "merged")
    original = LeRobotDataset("local/test", root=demos)
    assert merged.num_episodes == 1 + report["total"]["kept"]
    assert torch.equal(merged[7]["observation.image"], original[7]["observation.image"])
