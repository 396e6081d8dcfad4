"""What the flags of a run ask for beside the student: a teacher, collection rounds, the teacher's chunks on T."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

from lerobot_agpd.collect.round import RoundRunner
from lerobot_agpd.distill.environment import check_environment_fits, run_environment
from lerobot_agpd.distill.guided import future_steps
from lerobot_agpd.distill.own_teacher import OwnTeacher
from lerobot_agpd.distill.relabel import TeacherChunks
from lerobot_agpd.distill.state import DistillationState, replay_root
from lerobot_agpd.guidance.loading import check_teacher_fits, load_teacher
from lerobot_agpd.guidance.teacher import Teacher
from lerobot_agpd.replay.replay import Replay
from lerobot_agpd.replay.store import ReplayStore
from lerobot_agpd.run import RunInfo, process_rank, world_size

if TYPE_CHECKING:
    from lerobot_agpd.distill.student import DistilledStudent


def make_own_teacher(student: DistilledStudent, state: DistillationState) -> OwnTeacher | None:
    """Without a teacher's path, a student that can teach itself does (Table 1).

    Args:
        student: the policy in training.
        state: its progress; a resumed run goes on with the checkpoint's previous self.

    Raises:
        ValueError: if relabelling, or an adversary without collected episodes, needs another teacher.
    """
    config = student.config
    if config.teacher.path or not student.can_teach_itself:
        return None
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
        config.guidance if config.collect.guides else None,
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
    if config.replay.relabel != "none" and not masks_padding and teacher.n_chunk_steps < future_steps(config):
        raise ValueError(
            f"--policy.replay.relabel={config.replay.relabel}: the teacher predicts {teacher.n_chunk_steps} steps from "
            f"the current one on, the student's chunk has {future_steps(config)}, and its loss counts the recorded "
            "steps behind the teacher's; pass --policy.do_mask_loss_for_padding=true, which leaves them out"
        )
    return TeacherChunks(teacher, replay, future_steps(config), seed)
