"""What is said before LeRobot refuses a command: which file, which flag, and the way out."""

import json
import shutil
from pathlib import Path

import pytest
from lerobot.common.train_utils import update_last_checkpoint
from small_dataset import make_dataset

from lerobot_agpd.advice import advice

RESUME = ["lerobot-train", "--resume=true"]


def test_a_missing_last_link(save, output_dir):
    """LeRobot unlinks and links anew: killed in between, there is none."""
    folder = save()
    update_last_checkpoint(folder)
    last = output_dir / "checkpoints" / "last"
    command = [*RESUME, f"--config_path={last}/pretrained_model/train_config.json"]
    assert advice(command) == []
    last.unlink()
    (text,) = advice(command)
    assert f"--config_path={folder}/pretrained_model/train_config.json --resume=true" in text
    assert advice([*command[:-1], "--config_path", command[-1].partition("=")[2]]) == advice(command)


def test_a_resume_before_the_first_checkpoint(output_dir):
    last = output_dir / "checkpoints" / "last" / "pretrained_model" / "train_config.json"
    (text,) = advice([*RESUME, f"--config_path={last}"])
    assert f"{last} does not exist" in text and f"--policy.replay.root={output_dir / 'agpd'}" in text


def test_the_original_command_again(output_dir):
    command = ["/somewhere/lerobot_train.py", f"--output_dir={output_dir}"]
    (text,) = advice(command)
    assert f"--policy.replay.root={output_dir / 'agpd'}" in text
    assert advice([*command, "--resume=true"]) == []


@pytest.mark.parametrize(
    "command",
    [
        ["lerobot-train", "--output_dir=new"],
        ["lerobot-train"],
        [*RESUME, "--config_path=someone/repository"],
        [*RESUME, "--config_path=nowhere/checkpoints/last/pretrained_model/train_config.json"],
        ["lerobot-eval", "--output_dir=run"],
        ["-c"],
    ],
)
def test_other_commands_are_left_alone(command, output_dir, monkeypatch):
    monkeypatch.chdir(output_dir.parent)
    assert advice(command) == []


@pytest.mark.parametrize("name", ["pretrained_model/train_config.json", "training_state/training_step.json"])
def test_a_damaged_checkpoint(save, output_dir, name):
    """The newest one that can be read is named."""
    folder, older = save(step=4), save(step=2)
    config = folder / "pretrained_model" / "train_config.json"
    assert advice([*RESUME, f"--config_path={config}"]) == []
    (folder / name).write_text("{")
    (text,) = advice([*RESUME, f"--config_path={config}"])
    assert f"{folder / name} is damaged" in text and "\n" not in text
    assert f"--config_path={older}/pretrained_model/train_config.json --resume=true" in text


# ---- demonstrations ----


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    root = tmp_path_factory.mktemp("data") / "recorded"
    make_dataset(root)
    return root


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


FILES = [
    "meta/info.json",
    "meta/stats.json",
    "meta/tasks.parquet",
    "meta/episodes/*/*.parquet",
    "data/*/*.parquet",
]


@pytest.mark.parametrize("damage", [truncate, Path.unlink])
@pytest.mark.parametrize("pattern", FILES)
def test_demonstrations_that_cannot_be_read(recorded, tmp_path, pattern, damage):
    root = shutil.copytree(recorded, tmp_path / "copy")
    command = ["lerobot-train", "--dataset.repo_id=local/x", f"--dataset.root={root}"]
    assert advice(command) == []
    (path,) = root.glob(pattern)
    damage(path)
    (text,) = advice(command)
    assert text.startswith(f"--dataset.root={root}: ") and "\n" not in text
    named = path if damage is truncate or "*" not in pattern else root / pattern.split("/*")[0]
    assert str(named) in text and f"lerobot-agpd-doctor --dataset={root}" in text


def test_demonstrations_of_a_resumed_run(save, recorded, tmp_path):
    """Named by the configuration of the checkpoint; the command line comes first."""
    root = shutil.copytree(recorded, tmp_path / "copy")
    config = save() / "pretrained_model" / "train_config.json"
    content = json.loads(config.read_text())
    content["dataset"]["root"] = str(root)
    config.write_text(json.dumps(content))
    truncate(root / "meta" / "info.json")
    (text,) = advice([*RESUME, f"--config_path={config}"])
    assert f"--dataset.root={root}: {root / 'meta/info.json'} is damaged" in text
    assert advice([*RESUME, f"--config_path={config}", f"--dataset.root={recorded}"]) == []


def test_demonstrations_that_are_not_here_yet(tmp_path):
    assert advice(["lerobot-train", "--dataset.repo_id=lerobot/pusht"]) == []
    assert advice(["lerobot-train", f"--dataset.root={tmp_path / 'new'}"]) == []
