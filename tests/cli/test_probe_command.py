"""`lerobot-agpd-probe` on the teacher of FetchPickAndPlace, and what it refuses."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE

from lerobot_agpd.cli import probe

EXAMPLE = Path(__file__).parents[2] / "examples/fetch_pick_and_place"
FLAGS = {
    "teacher.path": str(EXAMPLE / "teacher"),
    "dataset.repo_id": "local/fetch_pick_and_place",
    "dataset.root": str(EXAMPLE / "demonstrations"),
    "states": 3,
    "samples": 24,
}


def call(monkeypatch, output, **changes) -> None:
    flags = {**FLAGS, "output": output, **changes}
    args = [f"--{name}={value}" for name, value in flags.items() if value is not None]
    monkeypatch.setattr(sys, "argv", ["lerobot-agpd-probe", *args])
    probe.main()


def test_a_teacher_with_one_way(monkeypatch, tmp_path, capsys):
    call(monkeypatch, tmp_path / "probe")
    content = json.loads((tmp_path / "probe/probe.json").read_text())
    assert content["verdict"]["finding"] == "one way"
    assert content["verdict"]["flags"] == "--policy.collect.strategy=teacher"
    assert "guidance will not help" in " ".join(capsys.readouterr().out.split())
    evidence = content["evidence"]
    assert evidence["starts"]["total"] == 3 and evidence["states"]["total"] == 3
    assert 0 < evidence["spread"] < 0.05
    assert [(pull["strategy"], pull["strength"]) for pull in evidence["pulls"]] == [
        ("teacher", 0),
        ("guided", 0.3),
        ("guided", 0.6),
        ("guided", 1.0),
        ("nearest", 4),
        ("nearest", 16),
    ]
    assert [row["steps"] for row in content["latency"]] == [1, 2, 4, 8, 10] and content["success"] == []
    assert all(row["milliseconds"] > 0 for row in content["latency"])
    assert len(content["states"]) == 6 and all(sum(row["weights"]) <= 1 for row in content["states"])
    assert (tmp_path / "probe/probe.png").stat().st_size > 10_000


def test_the_target_is_a_student_s_chunk_and_its_teacher_is_found(monkeypatch, student, teacher, tmp_path):
    rng, shapes = np.random.default_rng(0), {OBS_STATE: (2,), OBS_ENV_STATE: (16,), ACTION: (2,)}
    features = {key: {"dtype": "float32", "shape": shape, "names": None} for key, shape in shapes.items()}
    root = tmp_path / "data"
    dataset = LeRobotDataset.create("local/pusht", fps=10, features=features, root=root, use_videos=False)
    for _ in range(6):
        frame = {key: rng.uniform(0, 512, shape).astype(np.float32) for key, shape in shapes.items()}
        dataset.add_frame({**frame, "task": "push"})
    dataset.save_episode()
    dataset.finalize()
    data = {"dataset.repo_id": "local/pusht", "dataset.root": root, "teacher.path": None}
    call(monkeypatch, tmp_path / "probe", **data, **{"policy.path": student})
    content = json.loads((tmp_path / "probe/probe.json").read_text())
    assert content["student"] == str(student) and content["teacher"]["path"] == str(teacher)
    moved = {pull["strategy"]: pull["moved"] for pull in content["evidence"]["pulls"]}
    assert moved["teacher"] == 0 < moved["guided"], "guidance ends nearer to the student"


@pytest.mark.slow
def test_success_by_denoising_steps(monkeypatch, tmp_path):
    pytest.importorskip("gymnasium_robotics")
    env = {"env.type": "gymnasium_robotics", "env.task": "FetchPickAndPlace-v4"}
    call(monkeypatch, tmp_path / "probe", episodes=4, batch_size=4, **env)
    content = json.loads((tmp_path / "probe/probe.json").read_text())
    assert [row["steps"] for row in content["success"]] == [1, 2, 4, 8, 10]
    assert all(row["n"] == 4 and row["low"] <= row["mean"] <= row["high"] for row in content["success"])
    assert "denoising step" in content["verdict"]["reasons"][-1]
    stored = [json.loads(file.read_text())["request"] for file in (tmp_path / "probe/evaluations").iterdir()]
    assert sorted(request["sampler"][0] for request in stored) == [1, 2, 4, 8, 10]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"teacher.path": None}, "--teacher.path is not set"),
        ({"teacher.path": "nowhere"}, "--teacher.path='nowhere' is neither"),
        ({"dataset.repo_id": None}, "--dataset.repo_id is not set"),
        ({"dataset.root": "nowhere"}, "--dataset.root=nowhere is not the folder"),
        ({"dataset.repo_id": "no/such_dataset", "dataset.root": None}, "--dataset.repo_id=no/such_dataset"),
        ({"states": 0}, "--states must be at least 1"),
        ({"samples": 10}, "--samples must be at least 24"),
        ({"episodes": 1}, "--episodes must be at least 2"),
        ({"batch_size": 0}, "--batch_size must be at least 1"),
        ({"env_seed": 5}, "--env_seed=5"),
        ({"policy.path": EXAMPLE / "teacher"}, "--policy.path=.* has no teacher"),
        ({"teacher.num_inference_steps": 101}, "teacher.num_inference_steps=101 exceeds"),
        (
            {"env.type": "gymnasium_robotics", "env.task": "FetchReach-v4"},
            "the teacher .* needs the observations",
        ),
    ],
)
def test_refused_in_one_line_before_anything_is_written(monkeypatch, tmp_path, changes, message):
    with pytest.raises(SystemExit, match=f"lerobot-agpd-probe: .*{message}") as ended:
        call(monkeypatch, tmp_path / "probe", **changes)
    assert "\n" not in str(ended.value) and not (tmp_path / "probe").exists()
