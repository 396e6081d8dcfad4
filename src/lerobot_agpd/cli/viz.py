"""`lerobot-agpd-viz`: watch a teacher being guided toward a student, as a rerun recording."""

import logging
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import gymnasium as gym
import numpy as np
import rerun as rr
import torch
from lerobot.envs import close_envs, make_env, make_env_pre_post_processors
from rich.console import Console
from rich.table import Table

from lerobot_agpd.agpd import GuidedStrategy
from lerobot_agpd.cli.command import StudentFlags, entry_point
from lerobot_agpd.config import EVALUATION_SEEDS, require
from lerobot_agpd.guidance.strength import first_strength, require_strength
from lerobot_agpd.guidance.teacher import Teacher
from lerobot_agpd.loading import load_pair
from lerobot_agpd.progress import REPLAY_FOLDER, Progress
from lerobot_agpd.replay.episode import Array, EpisodeSpec
from lerobot_agpd.rollout.report import read_reports
from lerobot_agpd.rollout.rollout import Rollouts
from lerobot_agpd.studies.recording import DecisionRecorder, FrameRecorder, RolloutRecord
from lerobot_agpd.studies.rerun_log import blueprint, layout, log_rollout
from lerobot_agpd.studies.still import draw_still

logger = logging.getLogger(__name__)

APPLICATION = "lerobot-agpd-viz"


@dataclass
class VizConfig(StudentFlags):
    """Options of `lerobot-agpd-viz`."""

    # Episodes to record.
    episodes: int = 1
    # Environment seed of the first episode; also seeds the noise.
    seed: int = EVALUATION_SEEDS[0]
    # Strength of guidance, a pull, or a scale if the policy was trained with guidance.scale; default: that of the run's
    # next round, else the policy's.
    strength: float | None = None
    # Recording to write.
    output: Path = Path("outputs/rollout.rrd")
    # Still picture of the first episode to draw.
    png: Path | None = None
    # Record rendered frames.
    render: bool = True
    # Show the finished recording in a rerun viewer.
    open: bool = False

    def __post_init__(self) -> None:
        """Read the checkpoint's configuration and check the options.

        Raises:
            ValueError: if there is no checkpoint, or a number is out of range.
        """
        super().__post_init__()
        require(self.episodes >= 1, f"--episodes must be at least 1, got {self.episodes}")
        require(
            self.strength is None or self.strength >= 0,
            f"--strength must not be negative, got {self.strength}",
        )


# ---- student and teacher ----


def make_guided_strategy(config: VizConfig) -> GuidedStrategy:
    """The checkpoint's teacher, guided toward its student as during collection.

    Raises:
        FlagError: if teacher, student and environment do not fit together.
    """
    student_config = config.student
    sampler, teacher = load_pair(student_config, config.teacher, config.env)
    noise = torch.Generator(device=student_config.device or "cpu").manual_seed(config.seed)
    return GuidedStrategy(sampler.pair_with(teacher), noise, student_config.guidance)


def guidance_strength(config: VizConfig, teacher: Teacher) -> float:
    """`--strength`, else what the checkpoint's run would use in its next round, else where a run starts."""
    if config.strength is not None:
        return config.strength
    student_config = config.student
    assert student_config.pretrained_path is not None
    try:
        progress = Progress.read(student_config.pretrained_path)
    except FileNotFoundError:  # a checkpoint from the Hub, or one that never trained
        return first_strength(teacher, student_config.guidance)
    beside = student_config.pretrained_path.resolve().parents[2] / REPLAY_FOLDER
    reports = read_reports(Path(student_config.replay.root or beside))[: progress.rounds]
    if len(reports) < progress.rounds:
        logger.warning("the collected rounds of the checkpoint's run were not found")
        return first_strength(teacher, student_config.guidance)
    return reports[-1].next_strength if reports else first_strength(teacher, student_config.guidance)


# ---- recording a rollout ----


def record_rollouts(config: VizConfig, guided: GuidedStrategy, strength: float) -> Iterator[RolloutRecord]:
    """Play the episodes one by one."""
    tasks = make_env(config.env, n_envs=1)
    env = next(iter(next(iter(tasks.values())).values()))
    frames = FrameRecorder(env) if config.render else None
    recorder = DecisionRecorder(guided)
    processors = make_env_pre_post_processors(config.env, config.policy)
    specs = [EpisodeSpec(number, config.seed + number, strength) for number in range(config.episodes)]
    try:
        for episode in Rollouts(frames or env, processors, guided, recorder).run(specs):
            pictures = frames.frames if frames is not None else []
            to_frame = plane_to_frame(env.single_action_space, pictures[0] if pictures else None)
            yield RolloutRecord(episode, recorder.decisions, pictures, to_frame)
            recorder.decisions = []
    finally:
        close_envs(tasks)


def plane_to_frame(space: gym.Space, frame: Array | None) -> Callable[[Array], Array] | None:
    """How to draw two-dimensional actions: their bounds span the frame. None for other action spaces.

    Without a frame they are drawn in their own units.
    """
    if not (isinstance(space, gym.spaces.Box) and space.shape == (2,) and space.is_bounded()):
        return None
    if frame is None:
        return lambda actions: actions
    size = np.array([frame.shape[1], frame.shape[0]])
    return lambda actions: (actions - space.low) / (space.high - space.low) * size


# ---- the command ----


def visualize(config: VizConfig) -> Table:
    """Record the rollouts, and draw the still if one is wanted.

    Returns:
        A summary with one row per episode.
    """
    guided, guidance = make_guided_strategy(config), config.student.guidance
    strength = guidance_strength(config, guided.pair.teacher)
    if strength == 0:
        logger.warning("the %s is 0, so the guided teacher equals the teacher alone", guidance.unit)
    require_strength(guided.pair.teacher, strength, guidance, "--teacher.num_inference_steps")
    title = f"{guidance.unit} {strength:g}"
    table = Table("seed", "steps", "max reward", "success", "J alone", "J guided", title=title)
    layouts = []
    config.output.parent.mkdir(parents=True, exist_ok=True)
    with rr.RecordingStream(APPLICATION) as stream:
        stream.save(config.output)
        for number, rollout in enumerate(record_rollouts(config, guided, strength)):
            root = f"episode_{number}"
            log_rollout(stream, root, rollout)
            layouts.append(layout(root, rollout))
            stream.send_blueprint(blueprint(layouts))
            table.add_row(*_row(rollout))
            if config.png is not None and number == 0:
                config.png.parent.mkdir(parents=True, exist_ok=True)
                draw_still(rollout, config.png)
    return table


def _row(rollout: RolloutRecord) -> tuple[str, ...]:
    episode, decisions = rollout.episode, rollout.decisions
    success = "-" if episode.is_success is None else str(episode.is_success)
    alone = np.mean([decision.teacher_discrepancy for decision in decisions])
    guided = np.mean([decision.guided_discrepancy for decision in decisions])
    cells = (str(episode.spec.seed), str(len(episode)), f"{episode.max_reward:.3f}", success)
    return (*cells, f"{alone:.3g}", f"{guided:.3g}")


@entry_point("lerobot-agpd-viz")
def main(config: VizConfig) -> None:
    """Record and report."""
    Console().print(visualize(config))
    logger.info("recording in %s (open it with `rerun %s`)", config.output, config.output)
    if config.png is not None:
        logger.info("still picture in %s", config.png)
    if config.open:  # in a process of its own, which outlives this one
        command = [sys.executable, "-m", "rerun", str(config.output)]
        subprocess.Popen(command, start_new_session=True)  # noqa: S603  # no shell, this interpreter


if __name__ == "__main__":
    main()
