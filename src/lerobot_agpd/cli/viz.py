"""`lerobot-agpd-viz`: watch a teacher being guided toward a student, or policies side by side."""

import logging
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import rerun as rr
import torch
from lerobot.configs import parser
from lerobot.envs import close_envs, make_env, make_env_pre_post_processors
from rich.console import Console
from rich.table import Table

from lerobot_agpd.agpd import GuidedStrategy
from lerobot_agpd.cli.command import StudentFlags, entry_point, machine_device
from lerobot_agpd.config import EVALUATION_SEEDS
from lerobot_agpd.flag_checks import require
from lerobot_agpd.guidance.strength import first_strength, require_strength
from lerobot_agpd.guidance.teacher import Teacher
from lerobot_agpd.loading import load_pair
from lerobot_agpd.progress import REPLAY_FOLDER, Progress
from lerobot_agpd.replay.episode import EpisodeSpec
from lerobot_agpd.rollout.report import read_reports
from lerobot_agpd.rollout.rollout import Rollouts
from lerobot_agpd.studies.animation import Style, require_animation, write_animation
from lerobot_agpd.studies.clips import guided_clip, side_by_side
from lerobot_agpd.studies.recording import (
    DecisionRecorder,
    FrameRecorder,
    RolloutRecord,
    action_names,
    plane_to_frame,
)
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
    # Animation to write, .gif or .mp4: of --policies side by side if there are any, else of the guided rollouts.
    animation: Path | None = None
    # Name to checkpoint of policies that act alone, from the same starts; no recording is made of them.
    policies: dict[str, Path] = field(default_factory=dict)
    # Width of a panel of the animation, pixels.
    panel_width: int = 240
    # Show every how many-th step in the animation.
    stride: int = 1
    # Speed of the animation: 1 is the environment's own time, 0.5 half of it.
    speed: float = 1.0
    # Where the policies of --policies run; default: this machine's accelerator, else the CPU.
    device: str = ""
    # Record rendered frames.
    render: bool = True
    # Show the finished recording in a rerun viewer.
    open: bool = False

    def __post_init__(self) -> None:
        """Read the checkpoint's configuration and check the options.

        Raises:
            ValueError: if there is no checkpoint, or a number is out of range.
        """
        self.device = self.device or machine_device()
        self._check_animation()
        if not self.records:
            return
        super().__post_init__()
        require(
            self.strength is None or self.strength >= 0,
            f"--strength must not be negative, got {self.strength}",
        )

    @property
    def records(self) -> bool:
        """Whether a guided teacher is recorded; with --policies alone there is none."""
        return not self.policies or parser.get_path_arg("policy") is not None

    def _check_animation(self) -> None:
        require(self.episodes >= 1, f"--episodes must be at least 1, got {self.episodes}")
        require_animation(self.animation)
        require(
            not self.policies or self.animation is not None,
            "--policies are shown in an animation: name it with --animation=<file>.gif or .mp4",
        )
        require(
            self.render or self.animation is None,
            "--animation needs rendered frames, without --render=false",
        )
        require(self.speed > 0, f"--speed must be positive, got {self.speed}")
        for name in ("stride", "panel_width"):
            require(getattr(self, name) >= 1, f"--{name} must be at least 1, got {getattr(self, name)}")

    @property
    def style(self) -> Style:
        """How the animation looks."""
        return Style(self.panel_width, self.stride, fps=min(30.0, self.speed * self.env.fps / self.stride))


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
            to_frame = plane_to_frame(env, pictures[0] if pictures else None)
            yield RolloutRecord(episode, recorder.decisions, pictures, to_frame, action_names(env))
            recorder.decisions = []
    finally:
        close_envs(tasks)


# ---- the command ----


def animate_policies(config: VizConfig) -> None:
    """Write `--animation` of the policies that act alone."""
    assert config.animation is not None
    seeds = [config.seed + number for number in range(config.episodes)]
    write_animation(
        side_by_side(config.env, config.policies, seeds, config.device), config.animation, config.style
    )


def visualize(config: VizConfig) -> Table:
    """Record the rollouts, and draw the still and the animation if they are wanted.

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
    layouts, clips = [], []
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
            if config.animation is not None and not config.policies:
                clips.append(guided_clip(rollout))
    if clips and config.animation is not None:
        write_animation({"guided teacher": clips}, config.animation, config.style)
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
    if config.records:
        Console().print(visualize(config))
        logger.info("recording in %s (open it with `rerun %s`)", config.output, config.output)
    if config.policies:
        animate_policies(config)
    for kind, path in (("still picture", config.png), ("animation", config.animation)):
        if path is not None and path.is_file():
            logger.info("%s in %s (%d kB)", kind, path, path.stat().st_size // 1000)
    if config.open and config.records:  # in a process of its own, which outlives this one
        command = [sys.executable, "-m", "rerun", str(config.output)]
        subprocess.Popen(command, start_new_session=True)  # noqa: S603  # no shell, this interpreter


if __name__ == "__main__":
    main()
