"""Options of environment types and commands: every flag has its own help, every choice is checked."""

import dataclasses
from dataclasses import dataclass

import draccus
import pytest
from draccus.utils import DecodingError
from draccus.wrappers.docstring import get_attribute_docstring
from lerobot.envs.configs import EnvConfig

from lerobot_agpd.cli.demos import DemosConfig
from lerobot_agpd.cli.import_pusht import ImportPushTConfig
from lerobot_agpd.cli.import_robomimic import ImportRobomimicConfig
from lerobot_agpd.envs.aloha import AlohaStateEnvConfig
from lerobot_agpd.envs.gymnasium_robotics import GymnasiumRoboticsEnv
from lerobot_agpd.envs.point_maze import PointMazeWaysEnv
from lerobot_agpd.envs.robomimic import RobomimicEnvConfig

ENVIRONMENTS = (AlohaStateEnvConfig, GymnasiumRoboticsEnv, PointMazeWaysEnv, RobomimicEnvConfig)
COMMANDS = (DemosConfig, ImportPushTConfig, ImportRobomimicConfig)


@dataclass
class Command:
    """Options of a command with an environment, such as `lerobot-train`."""

    env: EnvConfig


def own_fields(config: type) -> list[str]:
    inherited = {name for base in config.__mro__[1:] for name in getattr(base, "__dataclass_fields__", {})}
    declared = config.__dict__["__annotations__"]
    return [f.name for f in dataclasses.fields(config) if f.name in declared or f.name not in inherited]


@pytest.mark.parametrize("config", [*ENVIRONMENTS, *COMMANDS])
def test_every_flag_has_a_comment_of_its_own_above_it(config):
    comments = {name: get_attribute_docstring(config, name) for name in own_fields(config)}
    assert all(comment.comment_above and not comment.comment_inline for comment in comments.values())
    assert all("\n" not in comment.comment_above for comment in comments.values())  # not its neighbor's, too
    texts = [comment.comment_above for name, comment in comments.items()]
    assert len(set(texts)) == len(texts)


@pytest.mark.parametrize("config", ENVIRONMENTS)
def test_choices_are_checked_wherever_they_come_from(config, capsys):
    name = EnvConfig.get_choice_name(config)
    with pytest.raises(SystemExit):
        draccus.parse(Command, args=[f"--env.type={name}", "--env.obs_type=smell"])
    error = capsys.readouterr().err
    assert all(word in error for word in ("--env.obs_type", "smell", "pixels_agent_pos"))
    with pytest.raises(DecodingError, match="smell.*pixels_agent_pos"):
        draccus.decode(EnvConfig, {"type": name, "obs_type": "smell"})
    with pytest.raises(
        (DecodingError, ValueError), match=f"laundry.*{config().task}|{config().task}.*laundry"
    ):
        draccus.parse(Command, args=[f"--env.type={name}", "--env.task=laundry"])


@pytest.mark.parametrize("config", ENVIRONMENTS)
def test_help_lists_the_choices(config, capsys):
    with pytest.raises(SystemExit):
        draccus.parse(Command, args=[f"--env.type={EnvConfig.get_choice_name(config)}", "--help"])
    text = capsys.readouterr().out
    assert "--env.obs_type {" in text and "pixels_agent_pos" in text and "what is observed" in text
