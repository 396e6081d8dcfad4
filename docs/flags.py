"""Write docs/flags.md: the flags of every policy type, environment type and command of this plugin, from the code.

usage: python docs/flags.py          (python docs/flags.py --check fails if the page is out of date)
"""

import dataclasses
import enum
import sys
import types
import typing
from pathlib import Path

from draccus.wrappers.docstring import get_attribute_docstring
from lerobot.configs import PreTrainedConfig
from lerobot.envs import EnvConfig
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig

import lerobot_agpd.plugin  # noqa: F401  # registers the types
from lerobot_agpd.cli import (
    compare,
    demos,
    diversity,
    doctor,
    export,
    import_adroit,
    import_pusht,
    import_robomimic,
    merge,
    probe,
    report,
    viz,
)
from lerobot_agpd.config import StudentConfig

DERIVED = ("features", "features_map")
"""Fields of environments that follow from the others."""

PAGE = Path(__file__).with_name("flags.md")
COMMANDS = {
    "lerobot-agpd-demos": demos.DemosConfig,
    "lerobot-agpd-import-adroit": import_adroit.ImportAdroitConfig,
    "lerobot-agpd-import-pusht": import_pusht.ImportPushTConfig,
    "lerobot-agpd-import-robomimic": import_robomimic.ImportRobomimicConfig,
    "lerobot-agpd-probe": probe.ProbeConfig,
    "lerobot-agpd-compare": compare.CompareConfig,
    "lerobot-agpd-report": report.ReportConfig,
    "lerobot-agpd-viz": viz.VizConfig,
    "lerobot-agpd-diversity": diversity.DiversityConfig,
    "lerobot-agpd-doctor": doctor.DoctorConfig,
    "lerobot-agpd-merge": merge.MergeConfig,
    "lerobot-agpd-export": export.ExportConfig,
}
INTRODUCTION = """\
# Flags

Generated from the code by `python docs/flags.py`. `--policy.type=agpd` also has every flag of LeRobot's `act`, the three
diffusion types those of its `diffusion`; flags that come from LeRobot unchanged are not listed here. A default of `None`
means what the last column says.
"""


def registered(base: type) -> dict[str, type]:
    """Types of this plugin in one of LeRobot's registries."""
    choices = base.get_known_choices()
    return {
        name: kind for name, kind in sorted(choices.items()) if kind.__module__.startswith("lerobot_agpd")
    }


def own_fields(kind: type, inherited: tuple[type, ...]) -> list[dataclasses.Field]:
    """Fields that a dataclass adds to LeRobot's, or to which it gives another default."""
    known = {field.name: field for base in inherited for field in dataclasses.fields(base)}
    return [
        field
        for field in dataclasses.fields(kind)
        if field.init and (field.name not in known or default(field) != default(known[field.name]))
    ]


def default(field: dataclasses.Field) -> object:
    """The default of a field; MISSING if it must be given."""
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return field.default


def group_of(kind: object) -> type | None:
    """The dataclass of a nested group of flags."""
    return kind if isinstance(kind, type) and dataclasses.is_dataclass(kind) else None


def type_name(kind: object) -> str:
    """A type as the page shows it; choices are spelled out."""
    if typing.get_origin(kind) is typing.Literal:
        return ", ".join(f"`{choice}`" for choice in typing.get_args(kind))
    if typing.get_origin(kind) in (types.UnionType, typing.Union):
        return ", ".join(type_name(part) for part in typing.get_args(kind))
    if typing.get_origin(kind) is not None:
        return f"`{str(kind).replace('typing.', '').replace('pathlib.', '')}`"
    return {"NoneType": "None"}.get(kind.__name__, kind.__name__) if isinstance(kind, type) else str(kind)


def shown_default(value: object) -> str:
    """A default as the page shows it."""
    if value is dataclasses.MISSING:
        return ""
    if isinstance(value, EnvConfig):
        return f"`{value.type}`"
    if isinstance(value, dict):
        value = {key: entry.name if isinstance(entry, enum.Enum) else entry for key, entry in value.items()}
    return f"`{value}`" if value != "" else "empty"


def rows(kind: type, prefix: str, inherited: tuple[type, ...] = ()) -> list[str]:
    """Table rows of a dataclass's flags, nested groups after its own."""
    hints = typing.get_type_hints(kind)
    lines, nested = [], []
    for field in own_fields(kind, inherited):
        flag, group = f"{prefix}{field.name}", group_of(hints[field.name])
        if group is not None and group.__module__.startswith("lerobot_agpd"):
            nested += rows(group, f"{flag}.")
        elif field.name not in DERIVED:
            text = " ".join(get_attribute_docstring(kind, field.name).comment_above.split())
            cells = (f"`--{flag}`", type_name(hints[field.name]), shown_default(default(field)), text)
            lines.append(f"| {' | '.join(cells)} |")
    return lines + nested


def table(lines: list[str]) -> str:
    """A table in markdown."""
    return "\n".join(["| flag | type | default | |", "| --- | --- | --- | --- |", *lines])


def page() -> str:
    """The whole page."""
    parts = [
        INTRODUCTION.rstrip(),
        "## Groups that every student has",
        table(rows(StudentConfig, "policy.", (PreTrainedConfig,))),
    ]
    for name, kind in registered(PreTrainedConfig).items():
        own = rows(kind, "policy.", (StudentConfig, ACTConfig, DiffusionConfig))
        parts += [f"## `--policy.type={name}`", table(own)] if own else []
    for name, kind in registered(EnvConfig).items():
        parts += [f"## `--env.type={name}`", table(rows(kind, "env.", (EnvConfig,)))]
    for name, kind in COMMANDS.items():
        parts += [f"## `{name}`", table(rows(kind, ""))]
    return "\n\n".join(parts) + "\n"


def main() -> None:
    """Write the page, or check it."""
    text = page()
    if "--check" in sys.argv:
        sys.exit(0 if PAGE.exists() and PAGE.read_text() == text else "out of date, run python docs/flags.py")
    PAGE.write_text(text)


if __name__ == "__main__":
    main()
