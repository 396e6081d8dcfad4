"""Every flag's help is the comment above its field, and the generated page is up to date."""

import argparse
import ast
import dataclasses
import inspect
import sys
import typing
from pathlib import Path

import draccus
import pytest
from draccus.argparsing import ArgumentParser
from lerobot.configs import PreTrainedConfig
from lerobot.envs import EnvConfig

sys.path.insert(0, str(Path(__file__).parents[2] / "docs"))
import flags as flags_page  # noqa: E402
from flags import COMMANDS, registered  # noqa: E402

DERIVED = ("features", "features_map", "type")


def comments_above(kind: type) -> dict[str, str]:
    """Field to the comment above it, for the fields that a class of this plugin declares itself."""
    lines = inspect.getsource(kind).splitlines()
    comments = {}
    for node in ast.parse("\n".join(lines)).body[0].body:
        if isinstance(node, ast.AnnAssign):
            above = node.lineno - 2
            block = []
            while above >= 0 and lines[above].strip().startswith("#"):
                block.insert(0, lines[above].strip().lstrip("# "))
                above -= 1
            comments[node.target.id] = " ".join(block)
    return comments


def flags(kind: type, prefix: str = "") -> dict[str, str]:
    """Option to comment, for the fields that classes of this plugin declare, nested groups too."""
    found = {}
    hints = inspect.get_annotations(kind, eval_str=True)
    for name, comment in comments_above(kind).items():
        nested = hints.get(name)
        if dataclasses.is_dataclass(nested) and nested.__module__.startswith("lerobot_agpd"):
            found |= flags(nested, f"{prefix}{name}.")
        else:
            found[f"--{prefix}{name}"] = comment
    return found


def options(kind: type) -> dict[str, argparse.Action]:
    """What a command that parses this class knows, by option."""
    return {
        option: action
        for action in ArgumentParser(config_class=kind).parser._actions
        for option in action.option_strings
    }


CLASSES = {**registered(PreTrainedConfig), **registered(EnvConfig), **COMMANDS}


@pytest.mark.parametrize("name", CLASSES)
def test_help_shows_each_flag_its_own_text(name):
    kind = CLASSES[name]
    bases = [base for base in kind.__mro__ if base.__module__.startswith("lerobot_agpd")]
    expected = {}
    for base in reversed([base for base in bases if dataclasses.is_dataclass(base)]):
        expected |= flags(base)
    actions = options(kind)
    for option, comment in expected.items():
        field = option.removeprefix("--")
        if field in DERIVED or option not in actions:  # types of registries have no flag of their own
            continue
        assert comment, f"{name}: {option} has no comment above its field"
        shown = " ".join((actions[option].help or "").split())
        if shown.startswith("Config file for"):  # a group; its text stands above the group's own flags
            continue
        assert shown.startswith(comment), f"{name}: the help of {option} is {shown!r}"


def test_choices_are_listed():
    actions = options(CLASSES["agpd"])
    assert set(actions["--collect.strategy"].choices) == {"guided", "nearest", "teacher", "mixing", "rollin"}
    assert set(actions["--guidance.at"].choices) == {"x0", "mu"}


@pytest.mark.parametrize(("base", "prefix"), [(PreTrainedConfig, "policy"), (EnvConfig, "env")])
def test_choices_of_one_type_do_not_bind_the_flags_of_another(base, prefix):
    """All types of a registry share one parser: a Literal of one would refuse what another takes."""
    declared: dict[str, set] = {}
    for kind in base.get_known_choices().values():
        for field in dataclasses.fields(kind):
            declared.setdefault(field.name, set()).add(str(field.type))
    for name, kind in registered(base).items():
        for field in dataclasses.fields(kind):
            choices = typing.get_origin(inspect.get_annotations(kind, eval_str=True).get(field.name))
            assert choices is not typing.Literal or len(declared[field.name]) == 1, f"{name}: {field.name}"
    args = {
        "policy": ["--policy.type=diffusion", "--policy.prediction_type=sample"],
        "env": ["--env.type=pusht"],
    }
    args["env"] += ["--env.obs_type=environment_state_agent_pos", "--env.task=PushT-v0"]
    wrapper = dataclasses.make_dataclass("Wrapper", [(prefix, base)])
    assert getattr(draccus.parse(wrapper, args=args[prefix]), prefix).type in ("diffusion", "pusht")


def test_page_is_up_to_date():
    assert flags_page.PAGE.read_text() == flags_page.page(), "run python docs/flags.py"
