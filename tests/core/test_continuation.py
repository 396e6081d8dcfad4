"""What to type after an interruption: the newest complete checkpoint, or the original command with two flags."""

import json
import shutil

from lerobot_agpd.continuation import announcement, how_to_continue, is_complete, newest_checkpoint

RESUME = ["lerobot-train", "--resume=true"]


def test_every_file_of_a_checkpoint_counts(save, output_dir):
    """Missing, empty or cut off: each makes it incomplete."""
    folder = save()
    assert is_complete(folder) and newest_checkpoint(output_dir) == folder
    files = [path for path in folder.rglob("*") if path.is_file() and "normalizer" not in path.name]
    files.remove(folder / "pretrained_model" / "README.md")  # the card
    assert len(files) >= 10
    for path in files:
        content = path.read_bytes()
        for damaged in (None, b"", content[:-2]):
            path.unlink() if damaged is None else path.write_bytes(damaged)
            assert not is_complete(folder), (path, damaged)
            path.write_bytes(content)
    config = folder / "pretrained_model" / "train_config.json"
    config.write_text(json.dumps({**json.loads(config.read_text()), "scheduler": {"type": "cosine"}}))
    assert not is_complete(folder), "the state of the schedule is missing"


def test_the_newest_complete_checkpoint_is_named(save, output_dir):
    first = save(9)
    shutil.copytree(first, output_dir / "checkpoints" / "000010")
    (output_dir / "checkpoints" / "000010" / "training_state" / "optimizer_state.safetensors").unlink()
    assert newest_checkpoint(output_dir) == first
    config = first / "pretrained_model" / "train_config.json"
    text = how_to_continue(output_dir, output_dir / "agpd")
    assert text.endswith(f"lerobot-train --config_path={config} --resume=true")
    moved = output_dir.rename(output_dir.with_name("moved"))
    assert how_to_continue(moved, moved / "agpd").endswith(f"--resume=true --output_dir={moved}")


def test_without_a_checkpoint_the_original_command_is_repeated(output_dir):
    root, second = output_dir / "agpd", output_dir.with_name("run-2")
    assert how_to_continue(output_dir, root).endswith(f"--output_dir={second} --policy.replay.root={root}")
    second.mkdir()
    assert f"--output_dir={output_dir.with_name('run-3')}" in how_to_continue(output_dir, root)


def test_a_run_says_how_it_goes_on_when_its_first_round_begins(start, caplog, tmp_path):
    caplog.set_level("INFO")
    run = start().train(until=6)
    text = announcement(tmp_path / "run", tmp_path / "run" / "agpd")
    assert [record.getMessage() for record in caplog.records].count(text) == 1
    assert (
        f"--config_path={tmp_path}/run/checkpoints/last/pretrained_model/train_config.json --resume=true"
        in text
    )
    assert f"--output_dir={tmp_path}/run-2 --policy.replay.root={run.agpd.journal.root}" in text
