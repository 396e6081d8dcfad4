"""What the flags of a run ask for beside the student: a teacher, collection rounds, the teacher's chunks on T."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

from lerobot_agpd.collect.round import RoundRunner
from lerobot_agpd.collect.strategies import needs_guidance
from lerobot_agpd.distill.environment import check_environment_fits, run_environment
from lerobot_agpd.distill.guided import executed_steps
from lerobot_agpd.distill.own_teacher import OwnTeacher
from lerobot_agpd.distill.relabel import TeacherChunks
from lerobot_agpd.distill.state import DistillationState, replay_root
from lerobot_agpd.guidance.config import require
from lerobot_agpd.guidance.loading import check_teacher_fits, load_teacher
from lerobot_agpd.guidance.teacher import Teacher
from lerobot_agpd.replay.frames import FrameTable
from lerobot_agpd.replay.replay import Replay
from lerobot_agpd.replay.store import ReplayStore
from lerobot_agpd.run import RunInfo, process_rank, world_size

if TYPE_CHECKING:
    from lerobot_agpd.distill.student import DistilledStudent

logger = logging.getLogger(__name__)


def make_own_teacher(student: DistilledStudent, state: DistillationState) -> OwnTeacher | None:
    """Without a teacher's path, a student that can teach itself does (Table 1).

    Args:
        student: the policy in training.
        state: its progress; a resumed run goes on with the checkpoint's previous self.

    Raises:
        ValueError: if relabelling, or an adversary without collected episodes, needs another teacher; for
            settings of a teacher that there is not.
    """
    config = student.config
    if config.teacher.path or not student.can_teach_itself:
        return None
    for name in ("num_inference_steps", "noise_scheduler"):
        value = getattr(config.teacher, name)
        require(
            value is None,
            f"--policy.teacher.{name}={value} has no meaning in self-distillation, where the student teaches as it "
            "samples itself; leave it out, or give a teacher (--policy.teacher.path)",
        )
    if config.replay.relabel != "none":
        raise ValueError(
            f"--policy.replay.relabel={config.replay.relabel} needs a teacher (--policy.teacher.path); in "
            "self-distillation the only one is the student"
        )
    if config.adversary.weight > 0 and not config.collect.enabled:
        raise ValueError(
            f"--policy.adversary.weight={config.adversary.weight} needs collected episodes: in "
            "self-distillation the adversary compares with them, and no round is to be collected; set it to 0, or "
            "--policy.collect.every above 0, or give a teacher (--policy.teacher.path)"
        )
    own_teacher = OwnTeacher(student)
    if state.checkpoint is not None:
        own_teacher.restore(Path(state.checkpoint))
    return own_teacher


def make_teacher(student: DistilledStudent, demonstrations: LeRobotDatasetMetadata) -> Teacher | None:
    """The teacher of `--policy.teacher.path`, if any part of the method uses one.

    Raises:
        ValueError: if it is missing, or does not fit the demonstrations.
    """
    config = student.config
    if not (config.collect.enabled or config.adversary.weight > 0 or config.replay.relabel != "none"):
        return None
    teacher = load_teacher(config.teacher, config.device)
    check_teacher_fits(
        teacher,
        student.demonstrated_features(demonstrations),
        config.action_feature,
        config.guidance if needs_guidance(config) else None,
    )
    return teacher


def make_rounds(
    config: Any,
    run: RunInfo,
    state: DistillationState,
    demonstrations: LeRobotDatasetMetadata,
    teacher: Teacher | None,
    seed: int,
) -> RoundRunner | None:
    """What collects the rounds, if any is to be collected; notes their folder in `state`.

    Raises:
        ValueError: if there is no environment, or it does not fit the policy or the teacher.
    """
    if not config.collect.enabled:
        return None
    env_config = run_environment(config.collect, run)
    check_environment_fits(env_config, config, teacher)
    guided = config.guidance.adaptive and config.guidance.scale > 0 and needs_guidance(config)
    if guided and int(config.collect.episodes * config.collect.unguided_fraction) == 0:
        logger.warning(
            "--policy.collect.unguided_fraction=%s of --policy.collect.episodes=%d is less than one episode: the "
            "teacher's own success rate stays unknown and the guidance scale at %s",
            config.collect.unguided_fraction,
            config.collect.episodes,
            config.guidance.scale,
        )
    teacher_recorded = config.collect.strategy == "mixing" and config.collect.mixing.relabel
    if config.collect.keep_failures and config.replay.relabel != "all" and not teacher_recorded:
        logger.warning(
            "--policy.collect.keep_failures=true with --policy.replay.relabel=%s: the student imitates the failures "
            "as they were recorded; --policy.replay.relabel=all gives it the teacher's chunks there",
            config.replay.relabel,
        )
    root = replay_root(config.replay, run, state)
    state.replay_root = str(root)
    return RoundRunner(
        store=ReplayStore(root),
        env_config=env_config,
        policy_config=config,
        demonstrations=demonstrations,
        seed=seed,
        rank=process_rank(),
        n_ranks=world_size(),
    )


def check_steps(student: DistilledStudent, teacher: Teacher | None, demonstrations: FrameTable) -> None:
    """Refuse numbers of executed steps that a round, or the learned J, could not work with.

    Args:
        student: the policy in training.
        teacher: None in self-distillation.
        demonstrations: their frames.

    Raises:
        ValueError: naming the flag.
    """
    n_steps, representation = executed_steps(student.config, teacher), student.representation
    if representation is None:
        return
    require(
        n_steps == representation.n_steps,
        f"--policy.representation.type=state predicts {representation.n_steps} steps ahead, and rounds execute "
        f"{n_steps} (the teacher's own number); set --policy.collect.n_action_steps={n_steps}",
    )
    longest = int((demonstrations.episode_end - demonstrations.episode_start).max())
    require(
        longest > n_steps,
        f"--policy.representation.type=state predicts {n_steps} steps ahead, and no demonstration is longer than "
        f"{longest}; set --policy.collect.n_action_steps below that",
    )
    collect = student.config.collect
    require(
        not (collect.strategy == "mixing" and collect.mixing.relabel),
        "--policy.collect.mixing.relabel=true records actions that were not executed, and "
        "--policy.representation.type=state learns what recorded actions lead to; use --policy.replay.relabel=all",
    )


def make_teacher_chunks(
    config: Any, teacher: Teacher | None, replay: Replay, seed: int
) -> TeacherChunks | None:
    """The teacher's chunks on T, if the adversary or relabelling uses them.

    Raises:
        ValueError: if relabelled chunks would end with recorded steps that the student's loss does not leave out.
    """
    if teacher is None or (config.adversary.weight == 0 and config.replay.relabel == "none"):
        return None
    masks_padding = getattr(config, "do_mask_loss_for_padding", True)  # without that setting: always, as ACT
    if config.replay.relabel != "none" and not masks_padding and teacher.n_chunk_steps < config.future_steps:
        raise ValueError(
            f"--policy.replay.relabel={config.replay.relabel}: the teacher predicts {teacher.n_chunk_steps} steps from "
            f"the current one on, the student's chunk has {config.future_steps}, and its loss counts the recorded "
            "steps behind the teacher's; pass --policy.do_mask_loss_for_padding=true, which leaves them out"
        )
    return TeacherChunks(teacher, replay, config.future_steps, seed)
