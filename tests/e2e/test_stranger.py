"""A teacher of somebody else that would run a program, on every way in: none runs it."""

import json
import shutil
import sys
from pathlib import Path

import pytest
from commands import PICK, TINY_STUDENT, dataset_flags, run_here

from lerobot_agpd.flag_checks import FlagError

PROGRAM = "from pathlib import Path\nPath(__file__).with_name('imported').touch()\n\ndef run(**_): pass\n"


@pytest.fixture
def stranger(fetch_teacher: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The example's teacher, whose postprocessor ends with a program."""
    monkeypatch.syspath_prepend(tmp_path / "programs")
    (tmp_path / "programs").mkdir()
    (tmp_path / "programs" / "agpd_program.py").write_text(PROGRAM)
    folder = shutil.copytree(fetch_teacher, tmp_path / "stranger")
    file = folder / "policy_postprocessor.json"
    content = json.loads(file.read_text())
    content["steps"].append({"class": "agpd_program.run", "config": {}})
    file.write_text(json.dumps(content))
    return folder


@pytest.mark.slow
def test_training(stranger: Path, fetch_demos: Path, tmp_path: Path) -> None:
    with pytest.raises(
        (FlagError, SystemExit), match="policy_postprocessor.json, step 2: 'agpd_program.run'"
    ):
        run_here(
            "lerobot-train",
            *TINY_STUDENT,
            *PICK,
            *dataset_flags(fetch_demos),
            f"--policy.teacher.path={stranger}",
            f"--output_dir={tmp_path / 'run'}",
            "--steps=1",
        )
    assert not (tmp_path / "programs" / "imported").exists() and "agpd_program" not in sys.modules


@pytest.mark.parametrize(
    ("command", "flags"),
    [
        ("lerobot-agpd-export", ["--checkpoint={stranger}", "--output={tmp}/exported"]),
        (
            "lerobot-agpd-report",
            ["--policies={{a: {stranger}}}", "--output={tmp}/report", "--episodes=2", *PICK],
        ),
    ],
)
def test_own_commands(stranger: Path, tmp_path: Path, command: str, flags: list[str]) -> None:
    filled = [flag.format(stranger=stranger, tmp=tmp_path) for flag in flags]
    with pytest.raises(
        SystemExit, match=f"{command}: .*policy_postprocessor.json, step 2: 'agpd_program.run'"
    ):
        run_here(command, *filled)
    assert not (tmp_path / "programs" / "imported").exists() and "agpd_program" not in sys.modules
