"""The model card of a checkpoint: README.md with what made it, what it achieved, and the commands to use it."""

from __future__ import annotations

import re
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import draccus
from huggingface_hub import EvalResult, ModelCard, ModelCardData
from lerobot.configs import PreTrainedConfig
from lerobot.envs import EnvConfig

from lerobot_agpd.cards.install import install_command

CARD = "README.md"
RESULTS = re.compile(r"(?<=<!-- results -->\n).*?(?=<!-- end of results -->)", re.DOTALL)
"""The part of a card that an evaluation replaces."""

NOT_EVALUATED = """\
Not evaluated yet. `lerobot-agpd-report` evaluates the checkpoint and writes its success rate here.
"""

EXTRAS = {
    "pusht": "pusht",
    "pusht_state": "pusht",
    "aloha": "aloha",
    "aloha_state": "aloha",
    "gymnasium_robotics": "fetch",
    "fetch_ways": "fetch",
    "point_maze_ways": "fetch",
    "robosuite_robomimic": "robomimic",
    "robosuite_ways": "robomimic",
}
"""`--env.type` to the extra of this package that installs its simulator."""

NO_REPOSITORY = "local/"
"""Namespace of datasets that are on nobody's Hub, in this project's examples."""


@dataclass(frozen=True)
class ModelFacts:
    """What a card says of a policy.

    Attributes:
        summary: what the policy is, a paragraph.
        facts: name to value, the rows of the card's table.
        dataset: repository of the demonstrations.
        base_model: Hub repository of the teacher; None if it is on no Hub.
        env: where it acts; None if unknown.
        sections: further sections of markdown.
        resumed: whether the run that trained it continued another one's checkpoint.
    """

    summary: str
    facts: Mapping[str, str]
    dataset: str
    base_model: str | None = None
    env: EnvConfig | None = None
    sections: Sequence[str] = field(default_factory=tuple)
    resumed: bool = False


def model_card(config: PreTrainedConfig, content: ModelFacts) -> ModelCard:
    """The card of a policy of this plugin.

    Args:
        config: the policy's.
        content: what made it.
    """
    repository = getattr(config, "repo_id", None)
    name = repository.rpartition("/")[2] if repository else config.type
    data = ModelCardData(
        license=config.license or "apache-2.0",
        library_name="lerobot",
        pipeline_tag="robotics",
        tags=sorted({*(config.tags or []), "robotics", "lerobot", config.type}),
        model_name=name,
        datasets=None if content.dataset.startswith(NO_REPOSITORY) else content.dataset,
        base_model=content.base_model,
    )
    rows = "\n".join(f"| {key} | {value} |" for key, value in content.facts.items())
    parts = [
        f"---\n{data.to_yaml()}\n---",
        f"# {name}",
        content.summary,
        f"| | |\n| --- | --- |\n{rows}",
        *content.sections,
        f"## Results\n\n<!-- results -->\n{NOT_EVALUATED}<!-- end of results -->",
        f"## Use it\n\n```bash\n{_usage(repository, content.env)}\n```",
        _training(content.resumed),
    ]
    return ModelCard("\n\n".join(parts) + "\n")


def _usage(repository: str | None, env: EnvConfig | None) -> str:
    path = repository or "<this folder or repository>"
    lines = [install_command(EXTRAS.get(env.type, "") if env else "")]
    if env is not None:
        lines.append(shlex.join(["lerobot-eval", f"--policy.path={path}", *environment_flags(env)]))
    lines.append(f"lerobot-rollout --policy.path={path} --robot.type=<your robot>   # on a robot")
    return "\n".join(lines)


def environment_flags(env: EnvConfig) -> list[str]:
    """The flags of `--env.*` that select an environment, those at their defaults left out."""
    default = draccus.encode(
        type(env)(task=env.task), EnvConfig
    )  # fields that the task decides are no choice
    changed = {
        key: value
        for key, value in draccus.encode(env, EnvConfig).items()
        if key not in ("type", "task") and value != default.get(key) and isinstance(value, str | int | float)
    }
    return [
        f"--env.type={env.type}",
        f"--env.task={env.task}",
        *(f"--env.{key}={value}" for key, value in changed.items()),
    ]


def _training(resumed: bool) -> str:
    """How the policy was trained: the command, if there was one, and where all settings are."""
    program = Path(sys.argv[0]).stem.replace("_", "-")  # with torchrun it is lerobot_train.py
    command = shlex.join([program, *sys.argv[1:]]) if program == "lerobot-train" else None
    text = "## How it was trained\n\n`train_config.json` in this folder has every setting. "
    if command is None:
        return text + "The run was started from Python."
    verb = "continued" if resumed else "started"
    return text + f"The run was {verb} with\n\n```bash\n{command}\n```"


# ---- results ----


def add_results(
    checkpoint: Path, text: str, environment: Mapping[str, Any], success: float, n_episodes: int
) -> bool:
    """Write an evaluation into the card of a checkpoint, in place of an earlier one.

    Args:
        checkpoint: folder of the policy.
        text: markdown.
        environment: fields of the environment, with `type` and `task`.
        success: rate, from 0 to 1.
        n_episodes: evaluated.

    Returns:
        Whether the folder holds a card of this plugin.
    """
    path = checkpoint / CARD
    if not path.is_file() or not RESULTS.search(path.read_text()):
        return False
    card = ModelCard.load(path)
    task = str(environment.get("task") or environment.get("type"))
    card.data.eval_results = [
        EvalResult(
            task_type="robotics",
            dataset_type=str(environment.get("type")),
            dataset_name=task,
            metric_type="success_rate",
            metric_name=f"success rate over {n_episodes} episodes",
            metric_value=round(success, 4),
        )
    ]
    card.text = RESULTS.sub(lambda match: f"\n{text}\n\n", card.text)
    card.save(path)
    return True
