"""Every command ends wrong input with one line, and loads the packages that register environments."""

import importlib
import sys

import pytest
from lerobot.envs.configs import PushtEnv

from lerobot_agpd.studies.parsing import decode_environment

PARSED = {
    "import_adroit": (["--source=nowhere", "--root=x"], "--source=nowhere"),
    "import_pusht": (["--source=nowhere", "--root=x"], "--source=nowhere"),
    "import_robomimic": (["nowhere.hdf5", "--root=x"], "--source=nowhere.hdf5"),
    "doctor": (["--run=nowhere"], "--run=nowhere is not a folder"),
    "merge": (["--root=nowhere"], "--root=nowhere is not a folder"),
    "probe": (["--output=x"], "--teacher.path is not set"),
    "report": (["--env.type=pusht", "--output=x", "--episodes=1", "--policies={a: .}"], "--episodes must be"),
    "demos": (["--env.type=gymnasium_robotics", "--root=x", "--episodes=0"], "--episodes"),
    "compare": (["--matrix=nowhere.yaml"], "--matrix=nowhere.yaml: no such file"),
    "export": (["--checkpoint=nowhere", "--output=x"], "--checkpoint='nowhere' is neither"),
    "viz": (["--env.type=pusht"], "--policy.path is not set"),
    "diversity": (["--env.type=pusht", "--output=x"], "--policy.path is not set"),
}
PLUGIN = """
from dataclasses import dataclass
from lerobot.envs import EnvConfig
from lerobot.envs.configs import PushtEnv

@EnvConfig.register_subclass("{name}")
@dataclass
class PluginEnv(PushtEnv):
    extra: int = 0
"""


def main(name: str, monkeypatch, *args: str):
    monkeypatch.setattr(sys, "argv", [name, *args])
    return importlib.import_module(f"lerobot_agpd.cli.{name}").main


@pytest.mark.parametrize("name", PARSED)
def test_one_line(name, monkeypatch, tmp_path):
    pytest.importorskip("lerobot_policy_agpd")
    args, message = PARSED[name]
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        main(name, monkeypatch, *args)()
    line = str(ended.value)
    assert (
        line.startswith(f"lerobot-agpd-{name.replace('_', '-')}: ") and message in line and "\n" not in line
    )
    assert not list(tmp_path.iterdir()), "nothing was begun"


def test_flags_and_the_checkpoint_may_come_from_a_file(monkeypatch, tmp_path):
    monkeypatch.setattr("lerobot.configs.parser._config_path_args", {})  # LeRobot keeps what a file says
    path = tmp_path / "flags.yaml"
    path.write_text(f"{{env: {{type: pusht}}, policy: {{path: {tmp_path / 'nowhere'}}}}}")
    with pytest.raises(SystemExit, match="lerobot-agpd-viz: .*nowhere"):
        main("viz", monkeypatch, f"--config_path={path}")()


@pytest.fixture
def plugin(monkeypatch, tmp_path, request) -> str:
    """A package, not installed, that registers an environment type of its own name."""
    name = f"plugin_{abs(hash(request.node.name))}"
    (tmp_path / name).mkdir()
    (tmp_path / name / "__init__.py").write_text(PLUGIN.format(name=name))
    monkeypatch.syspath_prepend(tmp_path)
    return name


@pytest.mark.parametrize("name", ["report", "viz", "diversity", "demos"])
def test_an_environment_of_another_package(name, monkeypatch, tmp_path, plugin):
    """The flags are read, and the command ends at what is wrong with the rest."""
    args = [f"--env.discover_packages_path={plugin}", f"--env.type={plugin}", "--env.extra=3"]
    others = {
        "report": ["--output=x", "--policies={a: .}", "--episodes=1"],
        "viz": [],
        "diversity": ["--output=x"],
        "demos": ["--root=x"],
    }
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit, match="--episodes must be|--policy.path is not set|no scripted exp"):
        main(name, monkeypatch, *args, *others[name])()


def test_an_environment_of_another_package_in_a_comparison(plugin):
    entries = {"discover_packages_path": plugin, "type": plugin, "extra": 3}
    config = decode_environment(entries)
    assert isinstance(config, PushtEnv) and config.extra == 3
    assert entries["discover_packages_path"] == plugin, "lerobot-train gets it as a flag, too"


def test_a_package_that_cannot_be_imported_is_named(monkeypatch):
    run = main("report", monkeypatch, "--env.discover_packages_path=no_such_package", "--env.type=pusht")
    with pytest.raises(SystemExit, match="lerobot-agpd-report: --env.discover_packages_path=no_such_package"):
        run()
