"""Wrong input ends every command with one line that names the flag."""

import importlib
import sys

import pytest

PARSED = {
    "import_pusht": (["--source=nowhere", "--root=x"], "nowhere"),
    "merge": (["--root=nowhere"], "--root=nowhere is not a folder"),
    "report": (["--env.type=pusht", "--output=x", "--episodes=1", "--policies={a: .}"], "--episodes must be"),
    "demos": (["--env.type=gymnasium_robotics", "--root=x", "--episodes=0"], "--episodes"),
    "compare": (["--matrix=nowhere.yaml"], "--matrix=nowhere.yaml: no such file"),
    "export": (["--checkpoint=nowhere", "--output=x"], "--checkpoint='nowhere' is neither"),
}


@pytest.mark.parametrize("name", PARSED)
def test_one_line(name, monkeypatch, tmp_path):
    pytest.importorskip("lerobot_policy_agpd")
    words, message = PARSED[name]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [name, *words])
    with pytest.raises(SystemExit) as ended:
        importlib.import_module(f"lerobot_agpd.cli.{name}").main()
    line = str(ended.value)
    assert (
        line.startswith(f"lerobot-agpd-{name.replace('_', '-')}: ") and message in line and "\n" not in line
    )
    assert not list(tmp_path.iterdir()), "nothing was begun"
