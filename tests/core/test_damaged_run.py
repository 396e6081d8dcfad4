"""A run that is resumed from damaged files stops with one line: which file, and what to do."""

import shutil
from pathlib import Path

import pytest

from lerobot_agpd.flag_checks import FlagError
from lerobot_agpd.replay import stored


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def garble(path: Path) -> None:
    path.write_text("{not json\n" + path.read_text().partition("\n")[2])


CHECKPOINT = "checkpoints/000007/pretrained_model/"
DAMAGE = {
    "truncated journal": ("agpd/journal.json", truncate, "restore it"),
    "damaged index line": ("agpd/round-00000/rank-0.jsonl", garble, "delete the line"),
    "truncated report": ("agpd/round-00001/report.json", truncate, "restore it"),
    "missing report": ("agpd/round-00000/report.json", Path.unlink, "restore it"),
    "missing round": ("agpd/round-00000", shutil.rmtree, "restore it"),
    "truncated episode": ("agpd/round-00000/rank-0-*.npy", truncate, "delete the line"),
    "missing episode": ("agpd/round-00000/rank-0-*.npy", Path.unlink, "delete the line"),
    "truncated weights": (CHECKPOINT + "model.safetensors", truncate, "checkpoint"),
    "truncated counters": (CHECKPOINT + "agpd_state.json", truncate, "earlier checkpoint"),
    "missing counters": (CHECKPOINT + "agpd_state.json", Path.unlink, "--policy.path"),
    "truncated processors": (CHECKPOINT + "policy_preprocessor.json", truncate, "restore it"),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_one_line_with_path_and_remedy(start, name):
    pattern, damage, remedy = DAMAGE[name]
    run = start().train(until=7).save()
    path = sorted(run.agpd.run.output_dir.glob(pattern))[0]
    damage(path)
    stored._memory_mapped.cache_clear()  # a resumed run is another process, which has opened nothing yet
    with pytest.raises((ValueError, FileNotFoundError, FlagError)) as stopped:
        start(run.checkpoint).train(until=8)
    message = str(stopped.value)
    named = path.parent if name == "missing report" else path
    assert str(named) in message and remedy in message and "\n" not in message
