"""Settings that make no sense, through the parser of `lerobot-train`."""

import contextlib
import io
import sys
from pathlib import Path

from lerobot.configs import parser
from lerobot.configs.train import TrainPipelineConfig

sys.path.append(str(Path(__file__).parents[2] / "tests" / "core"))
from wrong_settings import all_wrong_settings


@parser.wrap()
def received(config: TrainPipelineConfig) -> None:
    """What `lerobot-train` does until it has its configuration."""


def refusal(policy_type: str, setting: str) -> list[str]:
    """The line that names flag and value, or the lines where they are on several; empty if they are not said."""
    sys.argv = ["lerobot-train", f"--policy.type={policy_type}", "--policy.device=cpu"]
    sys.argv += ["--dataset.repo_id=local/x", "--env.type=point", f"--policy.{setting}"]
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            received()
    except SystemExit:
        flag, value = setting.split("=")
        shown = (value, value.removeprefix("-"), f"{value}.0")
        lines = [line.strip() for line in said.getvalue().splitlines()]
        naming = [number for number, line in enumerate(lines) if flag in line]
        for first in naming:
            for last in range(first, min(first + 3, len(lines))):
                if any(text in lines[last] for text in shown):
                    return lines[first : last + 1]
    return []


def refusals() -> dict[str, list[str]]:
    """The lines of every setting."""
    return {f"{name}: --policy.{setting}": refusal(name, setting) for name, setting in all_wrong_settings()}
