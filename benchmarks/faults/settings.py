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


def refusal(policy_type: str, setting: str) -> str | None:
    """The line that names flag and value; None if the setting is accepted, or refused without such a line."""
    sys.argv = ["lerobot-train", f"--policy.type={policy_type}", "--policy.device=cpu"]
    sys.argv += ["--dataset.repo_id=local/x", "--env.type=point", f"--policy.{setting}"]
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            received()
    except SystemExit:
        flag, value = setting.split("=")
        shown = {value, value.removeprefix("-"), f"{value}.0"}
        lines = [line.strip() for line in said.getvalue().splitlines() if flag in line]
        return next((line for line in lines if any(text in line for text in shown)), None)
    return None


def refusals() -> dict[str, str | None]:
    """The line of every setting."""
    return {f"{name}: --policy.{setting}": refusal(name, setting) for name, setting in all_wrong_settings()}
