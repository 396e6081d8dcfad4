"""Train, kill, resume, evaluate and export on FetchPickAndPlace, through LeRobot's own commands."""

import json
import shutil
import time
from pathlib import Path

import pytest
import torch
from commands import (
    PICK,
    TINY_STUDENT,
    dataset_flags,
    last_checkpoint,
    records,
    reports,
    round_folder,
    run,
    run_afresh,
    start,
)
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from safetensors import safe_open
from safetensors.torch import load_file

pytestmark = pytest.mark.slow

COLLECT = [
    "--policy.collect.warmup=6",
    "--policy.collect.every=6",
    "--policy.collect.episodes=8",
    "--policy.collect.n_envs=2",
    "--policy.adversary.start=3",
    "--steps=18",
    "--save_freq=6",
]


def test_killed_run_is_resumed_evaluated_and_exported(
    fetch_demos: Path, fetch_teacher: Path, tmp_path: Path
) -> None:
    teacher = tmp_path / "teacher"
    shutil.copytree(fetch_teacher, teacher)
    first = tmp_path / "first"
    process = start(
        "lerobot-train",
        *TINY_STUDENT,
        *PICK,
        *COLLECT,
        *dataset_flags(fetch_demos),
        f"--policy.teacher.path={teacher}",
        "--policy.representation.type=state",
        f"--output_dir={first}",
        log=tmp_path / "first.log",
    )
    deadline = time.monotonic() + 600
    while len(records(first, 1)) < 3:
        assert process.is_alive(), (tmp_path / "first.log").read_text()[-5000:]
        assert time.monotonic() < deadline
        time.sleep(0.02)
    process.kill()  # SIGKILL
    process.join()
    before = records(first, 1)
    assert 3 <= len(before) < 8, "killed in the middle of a round"

    moved = tmp_path / "moved"
    first.rename(moved)
    config = last_checkpoint(moved) / "train_config.json"
    run("lerobot-train", f"--config_path={config}", "--resume=true", f"--output_dir={moved}")

    rounds = reports(moved)
    assert [(report["round"], report["step"]) for report in rounds] == [(0, 6), (1, 12)], "none at step 18"
    after = records(moved, 1)
    assert after[: len(before)] == before, "no episode is lost"
    assert sorted(record["number"] for record in after) == list(range(8)), "none is collected twice"
    assert rounds[1]["total"]["generated"] == 8

    kept = sum(record["kept"] for number in range(2) for record in records(moved, number))
    assert kept == sum(report["total"]["kept"] for report in rounds) > 0
    merged = LeRobotDataset("local/merged", root=moved / "agpd" / "merged")
    assert merged.num_episodes == kept
    assert {"agpd.round", "agpd.strength", "agpd.strategy"} <= set(merged.features)

    checkpoint = last_checkpoint(moved)
    state = json.loads((checkpoint / "agpd_state.json").read_text())
    assert (state["step"], state["rounds"]) == (18, 2)
    with safe_open(checkpoint / "model.safetensors", "pt") as weights:
        assert {key.split(".")[0] for key in weights.keys()} == {"model", "discriminator", "representation"}  # noqa: SIM118
    assert json.loads((checkpoint / "config.json").read_text())["collect"]["env"] is None

    shutil.rmtree(teacher)
    run(
        "lerobot-eval",
        f"--policy.path={checkpoint}",
        "--policy.device=cpu",
        *PICK,
        "--eval.n_episodes=2",
        "--eval.batch_size=2",
        "--eval.use_async_envs=false",
        f"--output_dir={tmp_path / 'eval'}",
    )
    assert json.loads((tmp_path / "eval" / "eval_info.json").read_text())["overall"]["n_episodes"] == 2

    act = tmp_path / "act"
    run("lerobot-agpd-export", f"--checkpoint={checkpoint}", f"--output={act}")
    load = (
        "import sys, torch\n"
        "from lerobot.policies.act.modeling_act import ACTPolicy\n"
        f"policy = ACTPolicy.from_pretrained({str(act)!r}, strict=True)\n"
        "batch = {'observation.state': torch.ones(1, 10), 'observation.environment_state': torch.ones(1, 18)}\n"
        "assert policy.select_action(batch).shape == (1, 4)\n"
        "assert not any(name.startswith('lerobot_agpd') for name in sys.modules)\n"
    )
    run_afresh("python", "-c", load)


def test_resuming_changes_nothing(fetch_demos: Path, fetch_teacher: Path, tmp_path: Path) -> None:
    """Weights at step 12 are the same, bit for bit, whether or not the run stopped at step 8.

    Without ACT's own noise (VAE, dropout): starting a data loader draws from torch's generator, so LeRobot does
    not resume noise exactly.
    """
    output = tmp_path / "run"
    run(
        "lerobot-train",
        *TINY_STUDENT,
        "--policy.use_vae=false",
        "--policy.dropout=0",
        *PICK,
        *dataset_flags(fetch_demos),
        f"--policy.teacher.path={fetch_teacher}",
        "--policy.collect.warmup=4",
        "--policy.collect.every=6",
        "--policy.collect.episodes=4",
        "--policy.adversary.start=2",
        "--steps=12",
        "--save_freq=8",
        f"--output_dir={output}",
    )
    straight = load_file(output / "checkpoints" / "000012" / "pretrained_model" / "model.safetensors")
    shutil.rmtree(output / "checkpoints" / "000012")
    shutil.rmtree(round_folder(output, 1))  # collected at step 10, after the checkpoint
    config = output / "checkpoints" / "000008" / "pretrained_model" / "train_config.json"
    run("lerobot-train", f"--config_path={config}", "--resume=true")
    resumed = load_file(output / "checkpoints" / "000012" / "pretrained_model" / "model.safetensors")
    assert straight.keys() == resumed.keys()
    assert [key for key in straight if not torch.equal(straight[key], resumed[key])] == []


def test_two_processes_share_a_round(fetch_demos: Path, fetch_teacher: Path, tmp_path: Path) -> None:
    output = tmp_path / "run"
    run_afresh(
        "torchrun",
        "--standalone",
        "--nproc_per_node=2",
        "-m",
        "lerobot.scripts.lerobot_train",
        *TINY_STUDENT,
        *PICK,
        *dataset_flags(fetch_demos),
        f"--policy.teacher.path={fetch_teacher}",
        "--policy.collect.warmup=3",
        "--policy.collect.every=5",
        "--policy.collect.rounds=1",
        "--policy.collect.episodes=7",
        "--policy.adversary.start=2",
        "--steps=5",
        f"--output_dir={output}",
    )
    (report,) = reports(output)
    episodes = [records(output, 0, rank) for rank in range(2)]
    numbers = [sorted(record["number"] for record in part) for part in episodes]
    assert numbers == [[0, 1, 2, 3], [4, 5, 6]]
    assert len({record["seed"] for part in episodes for record in part}) == 7
    kept = sum(record["kept"] for part in episodes for record in part)
    assert (report["total"]["generated"], report["total"]["kept"]) == (7, kept)
    assert LeRobotDataset("x", root=output / "agpd" / "merged").num_episodes == kept > 0
    assert last_checkpoint(output).is_dir()


def test_a_run_without_any_success_goes_on_cloning(
    fetch_demos: Path, fetch_teacher: Path, tmp_path: Path
) -> None:
    output = tmp_path / "run"
    printed = run(
        "lerobot-train",
        *TINY_STUDENT,
        *PICK,
        *dataset_flags(fetch_demos),
        f"--policy.teacher.path={fetch_teacher}",
        "--policy.collect.warmup=2",
        "--policy.collect.every=2",
        "--policy.collect.min_reward=1",  # Fetch pays at most 0
        "--policy.collect.episodes=2",
        "--policy.adversary.start=1",
        "--steps=6",
        f"--output_dir={output}",
    )
    assert "--policy.collect.min_reward" in printed
    totals = [report["total"] for report in reports(output)]
    assert [(total["generated"], total["kept"]) for total in totals] == [(2, 0)] * 2
    assert not (output / "agpd" / "merged").exists()
    assert (output / "checkpoints" / "000006").is_dir()
