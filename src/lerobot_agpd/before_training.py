"""Checks before training starts, beside those of `fit`: the checkpoint, the environment's images, steps and strengths."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping

from lerobot.configs import FeatureType
from lerobot.envs import EnvConfig

from lerobot_agpd.config import StudentConfig
from lerobot_agpd.continuation import damaged_file, how_to_continue
from lerobot_agpd.flag_checks import require
from lerobot_agpd.guidance.strength import STEPS_FLAG, first_strength, require_strength
from lerobot_agpd.guidance.teacher import Teacher
from lerobot_agpd.progress import REPLAY_FOLDER, Progress
from lerobot_agpd.replay.demonstrations import DemonstrationFrames
from lerobot_agpd.replay.episode import Array
from lerobot_agpd.replay.normalization import Statistics
from lerobot_agpd.rollout.first_observation import first_observation
from lerobot_agpd.self_distillation import SelfTeacher
from lerobot_agpd.student import Student, executed_steps

logger = logging.getLogger(__name__)


def require_intact(progress: Progress) -> None:
    """Refuse a checkpoint with a damaged file, which LeRobot would read later, and name neither path nor remedy.

    Raises:
        ValueError: naming the file, and how the run goes on.
    """
    if progress.checkpoint is None:
        return
    folder = progress.checkpoint.parent
    damaged = damaged_file(folder)
    if damaged is not None:
        run_folder = folder.parent.parent
        raise ValueError(
            f"{damaged} is damaged; restore it, or continue from another checkpoint: "
            f"{how_to_continue(run_folder, run_folder / REPLAY_FOLDER)}"
        )


def check_steps(student: Student, teacher: Teacher | None, demonstrations: DemonstrationFrames) -> None:
    """Refuse numbers of executed steps that a round, or the learned J, could not work with."""
    n_steps, representation = executed_steps(student.config, teacher), student.representation
    if representation is None:
        return
    flag = f"--policy.representation.type={student.config.representation.type}"
    require(
        n_steps == representation.n_steps,
        f"{flag} predicts {representation.n_steps} steps ahead, and rounds execute "
        f"{n_steps} (the teacher's own number); set --policy.collect.n_action_steps={n_steps}",
    )
    longest = int(demonstrations.table.lengths.max())
    require(
        longest > n_steps,
        f"{flag} predicts {n_steps} steps ahead, and no demonstration is longer than "
        f"{longest}; set --policy.collect.n_action_steps below that",
    )
    collect = student.config.collect
    require(
        not (collect.strategy == "mixing" and collect.mixing.record_teacher),
        "--policy.collect.mixing.record_teacher=true records actions that were not executed, and "
        f"{flag} learns what recorded actions lead to; use --policy.replay.relabel=all",
    )


def check_strength(
    config: StudentConfig,
    teacher: Teacher | None,
    self_teacher: SelfTeacher | None,
    stats: Statistics,
) -> None:
    """Refuse a first round that guides more strongly than the teacher's denoising steps can follow."""
    guidance, steps_flag = config.guidance, STEPS_FLAG
    if self_teacher is not None:
        teacher = self_teacher.unchanged(stats)
        steps_flag = "--policy.num_inference_steps"
    if config.needs_guidance and teacher is not None:
        require_strength(teacher, first_strength(teacher, guidance), guidance, steps_flag)


def warn_of_settings(config: StudentConfig) -> None:
    """Warn of settings that are allowed and seldom intended."""
    collect = config.collect
    adapts = config.guidance.adaptive and config.guidance.first_strength > 0 and config.needs_guidance
    if adapts and int(collect.episodes * collect.teacher_only_fraction) == 0:
        logger.warning(
            "--policy.collect.teacher_only_fraction=%s of --policy.collect.episodes=%d is less than one episode: the "
            "teacher's own success rate stays unknown and the %s of guidance at %s",
            collect.teacher_only_fraction,
            collect.episodes,
            config.guidance.unit,
            config.guidance.first_strength,
        )
    teacher_recorded = collect.strategy == "mixing" and collect.mixing.record_teacher
    if collect.keep_failures and config.replay.relabel != "all" and not teacher_recorded:
        logger.warning(
            "--policy.collect.keep_failures=true with --policy.replay.relabel=%s: the student imitates the failures "
            "as they were recorded; --policy.replay.relabel=all gives it the teacher's chunks there",
            config.replay.relabel,
        )


def check_environment(
    config: StudentConfig,
    teacher: Teacher | None,
    env_config: EnvConfig,
    check: Callable[[Mapping[str, Array]], None],
) -> None:
    """Check the first observation of an environment that shows cameras to student or teacher.

    Environments declare sizes of images that they do not always deliver.

    Args:
        config: the student's.
        teacher: None in self-distillation.
        env_config: the environment.
        check: raises if an observation (vectors (D,), images (H, W, C)) could not be kept.
    """
    observed = [
        *(config.input_features or {}).values(),
        *(teacher.input_features.values() if teacher else ()),
    ]
    if any(feature.type is FeatureType.VISUAL for feature in observed):
        check(first_observation(env_config, config))
