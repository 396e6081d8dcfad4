"""Registration of the plugin's types, each on its own."""

import logging
import subprocess
import sys
import textwrap
from dataclasses import dataclass

import draccus
import pytest
from lerobot.configs import PreTrainedConfig
from lerobot.envs.configs import EnvConfig

from lerobot_agpd import plugin

MODULE = """
from dataclasses import dataclass
from test_plugin import Registry

@Registry.register_subclass("{name}")
@dataclass
class Config(Registry):
    pass
"""


@dataclass
class Registry(draccus.ChoiceRegistry):
    """Stands for EnvConfig; filled and emptied by every test."""


@pytest.fixture
def modules(tmp_path, monkeypatch):
    """Writes modules that register a type of their own name; forgets them and their types in the end."""
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setitem(sys.modules, "test_plugin", sys.modules[__name__])
    monkeypatch.setattr(Registry, "_choice_registry", {})

    def write(**sources: str) -> dict[str, str]:
        for name, source in sources.items():
            (tmp_path / f"agpd_stub_{name}.py").write_text(source or MODULE.format(name=name))
        return {name: f"agpd_stub_{name}" for name in sources}

    yield write
    for name in [name for name in sys.modules if name.startswith("agpd_stub_")]:
        del sys.modules[name]


def test_all_types_are_registered():
    assert all(
        EnvConfig.get_known_choices()[name].__module__ == path for name, path in plugin.ENV_TYPES.items()
    )
    policies = PreTrainedConfig.get_known_choices()
    assert all(policies[name].__module__ == path for name, path in plugin.POLICY_TYPES.items())


def test_a_clash_costs_only_that_type(modules, caplog):
    @Registry.register_subclass("taken")
    @dataclass
    class Foreign(Registry):
        pass

    with caplog.at_level(logging.WARNING):
        plugin.register("--env.type", Registry, modules(first="", taken="", last=""))
    assert set(Registry.get_known_choices()) == {"first", "taken", "last"}
    assert Registry.get_choice_class("taken") is Foreign
    (record,) = caplog.records
    assert "--env.type=taken" in record.message and Foreign.__qualname__ in record.message


def test_a_broken_module_costs_only_its_type_and_shows_its_error(modules, caplog):
    with caplog.at_level(logging.WARNING):
        plugin.register("--env.type", Registry, modules(first="", broken="1 / 0", last=""))
    assert set(Registry.get_known_choices()) == {"first", "last"}
    (record,) = caplog.records
    assert "--env.type=broken" in record.message and "ZeroDivisionError" in caplog.text


def test_registering_twice_is_silent(modules, caplog):
    names = modules(first="", last="")
    plugin.register("--env.type", Registry, names)
    plugin.register("--env.type", Registry, names)
    assert not caplog.records


@pytest.mark.slow
def test_policies_are_there_when_another_plugin_holds_an_environment_type():
    script = """
        from dataclasses import dataclass
        from lerobot.configs import PreTrainedConfig
        from lerobot.envs.configs import EnvConfig

        @EnvConfig.register_subclass("robosuite_robomimic")
        @dataclass
        class Foreign(EnvConfig):
            gym_kwargs = {}

        import lerobot_policy_agpd
        assert EnvConfig.get_choice_class("robosuite_robomimic") is Foreign
        assert "aloha_state" in EnvConfig.get_known_choices()
        assert "agpd" in PreTrainedConfig.get_known_choices()
    """
    argv = [sys.executable, "-c", textwrap.dedent(script)]
    ended = subprocess.run(argv, capture_output=True, text=True, timeout=600)
    assert ended.returncode == 0, ended.stderr
    assert "--env.type=robosuite_robomimic" in ended.stderr and "__main__" in ended.stderr
