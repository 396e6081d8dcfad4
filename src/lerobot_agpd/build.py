"""Put together what AGPD needs beside the student: teacher, replay, journal and collector, as the flags say."""

from __future__ import annotations

import logging
from collections.abc import Collection
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from accelerate import PartialState
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.envs import EnvConfig

from lerobot_agpd.before_training import (
    check_environment,
    check_steps,
    check_strength,
    require_intact,
    warn_of_settings,
)
from lerobot_agpd.config import StudentConfig
from lerobot_agpd.fit import check_fit, vectors
from lerobot_agpd.flag_checks import require
from lerobot_agpd.guidance.teacher import Teacher
from lerobot_agpd.identity import chunk_identity, episode_identity
from lerobot_agpd.loading import collection_environment, load_teacher
from lerobot_agpd.progress import Progress, find_replay_root
from lerobot_agpd.references import References, make_references
from lerobot_agpd.replay.backgrounds import require_masks
from lerobot_agpd.replay.chunk_store import FOLDER, ChunkStore
from lerobot_agpd.replay.demonstrations import DemonstrationFrames, require_dataset
from lerobot_agpd.replay.export import check_observation
from lerobot_agpd.replay.frame_features import FrameFeatures
from lerobot_agpd.replay.journal import EpisodeJournal
from lerobot_agpd.replay.normalization import Statistics
from lerobot_agpd.replay.replay import Replay
from lerobot_agpd.replay.teacher_chunks import TeacherChunks
from lerobot_agpd.rollout.collector import Collector
from lerobot_agpd.rollout.report import RoundReport, read_reports
from lerobot_agpd.run import RunInfo
from lerobot_agpd.self_distillation import SelfTeacher
from lerobot_agpd.student import Student
from lerobot_agpd.textures import Textures

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Parts:
    """What AGPD needs beside the student; none of it enters a checkpoint's weights.

    Attributes:
        run: the training run.
        progress: counters, restored if the run continues a checkpoint.
        replay: T.
        frame_features: what the representation predicts of T's camera frames; None where it predicts vectors, or there is
            none.
        teacher: None without one, and in self-distillation.
        self_teacher: in self-distillation.
        teacher_chunks: the teacher's chunks at the frames of T; None if they are not used.
        references: what the adversary compares the student with.
        collector: None if no round is to be collected.
        journal: the collected episodes on disk; None if no round is to be collected.
        reports: of the rounds that T holds already.
        seed: of environments, sampling noise and the choice of collected frames.
        rank: of this process.
    """

    run: RunInfo
    progress: Progress
    replay: Replay
    frame_features: FrameFeatures | None
    teacher: Teacher | None
    self_teacher: SelfTeacher | None
    teacher_chunks: TeacherChunks | None
    references: References
    collector: Collector | None
    journal: EpisodeJournal | None
    reports: tuple[RoundReport, ...]
    seed: int
    rank: int


def build_parts(
    student: Student,
    dataset_meta: LeRobotDatasetMetadata | None,
    dataset_stats: Statistics | None,
    run: RunInfo,
    seed: int,
) -> Parts:
    """Build the parts, checking that they fit together.

    Args:
        student: the policy in training.
        dataset_meta: metadata of the demonstrations.
        dataset_stats: their statistics.
        run: the training run.
        seed: of environments, sampling noise and the choice of collected frames.

    Raises:
        FlagError: if a teacher or an environment is needed and missing, or does not fit.
        ValueError: if there are no demonstrations, or collected episodes are another run's or damaged.
        FileNotFoundError: if a checkpoint's counters or collected episodes are missing.
    """
    config, processes = student.config, PartialState()
    require(
        not run.sharded,
        "--parallelism.*: AGPD collects with whole policies, so it cannot shard them; use DDP",
    )
    dataset_meta = require_dataset(dataset_meta)
    progress = Progress.restore(config, run)
    require_intact(progress)
    self_teacher = _self_teacher(student, progress)
    teacher = None if self_teacher else _teacher(config)
    env_config = collection_environment(config.collect, run) if config.collect.enabled else None
    check_fit(config, teacher, dataset_meta, env_config)
    also_held = vectors(teacher.input_features) if teacher else []
    demonstrations = DemonstrationFrames(config, dataset_meta, dataset_stats, also_held)
    meta = demonstrations.dataset.meta
    replay = Replay(
        demonstrations,
        config,
        config.replay.collected_fraction,
        run.image_transforms,
        _backgrounds(config, meta, env_config),
    )
    replay.see(progress.seen_episodes)
    collector, journal = None, None
    root = _root(config, run, progress)
    if env_config is not None:
        check_steps(student, teacher, demonstrations)
        check_strength(config, teacher, self_teacher, meta.stats or {})
        warn_of_settings(config)
        journal = _journal(config, root, progress, meta, env_config, seed)
        check = partial(check_observation, meta.features)
        check_environment(config, teacher, env_config, check)
        rank, n_ranks = processes.process_index, processes.num_processes
        collector = Collector(config, env_config, meta, journal, check, seed, rank, n_ranks)
    teacher_chunks, references = make_references(
        config, teacher, replay, progress, seed, _chunk_store(config, replay, seed, root)
    )
    return Parts(
        run=run,
        progress=progress,
        replay=replay,
        frame_features=_frame_features(student, replay),
        teacher=teacher,
        self_teacher=self_teacher,
        teacher_chunks=teacher_chunks,
        references=references,
        collector=collector,
        journal=journal,
        reports=_adopt_rounds(journal, replay, progress),
        seed=seed,
        rank=processes.process_index,
    )


def _backgrounds(
    config: StudentConfig, demonstrations: LeRobotDatasetMetadata, env_config: EnvConfig | None
) -> Textures | None:
    if config.replay.backgrounds is None:
        return None
    sources: dict[str, Collection[str]] = {"the demonstrations (--dataset.*)": demonstrations.features}
    if env_config is not None:
        sources["the observations of the environment (--env.*)"] = env_config.features_map.values()
    require_masks(list(config.image_features), sources)
    return Textures(config.replay.backgrounds, "--policy.replay.backgrounds")


def _frame_features(student: Student, replay: Replay) -> FrameFeatures | None:
    encoder, config = student.visual_encoder, student.config
    if encoder is None:
        return None
    encoder.load()
    return FrameFeatures(replay.frames, list(config.image_features), encoder, replay.demonstrations)


# ---- teacher ----


def _teacher(config: StudentConfig) -> Teacher | None:
    """The teacher of `--policy.teacher.path`, if any part of the method uses one."""
    if not config.uses_teacher:
        return None
    teacher = load_teacher(config.teacher, config.device or "cpu")
    if config.collect.enabled and config.needs_guidance:
        teacher.require_guidance(config.guidance.at)
    return teacher


def _self_teacher(student: Student, progress: Progress) -> SelfTeacher | None:
    """Without a teacher's path, a student that can teach itself does (Table 1)."""
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
    require(
        config.replay.relabel == "none",
        f"--policy.replay.relabel={config.replay.relabel} needs a teacher (--policy.teacher.path); in "
        "self-distillation the only one is the student",
    )
    require(
        config.adversary.weight == 0 or config.collect.enabled,
        f"--policy.adversary.weight={config.adversary.weight} needs collected episodes: in self-distillation the "
        "adversary compares with them, and no round is to be collected; set it to 0, or --policy.collect.every above 0, "
        "or give a teacher (--policy.teacher.path)",
    )
    self_teacher = SelfTeacher(student)
    if progress.checkpoint is not None:
        self_teacher.restore(progress.checkpoint)
    return self_teacher


def _chunk_store(config: StudentConfig, replay: Replay, seed: int, root: Path | None) -> ChunkStore | None:
    """Where the teacher's chunks at recorded frames are kept, beside the journal."""
    if root is None:
        return None
    identity = chunk_identity(config, replay.demonstrations.dataset.meta, seed)
    return ChunkStore(root.with_name(FOLDER), identity, writes=PartialState().is_main_process)


# ---- collection ----


def _root(config: StudentConfig, run: RunInfo, progress: Progress) -> Path | None:
    """Folder of the collected episodes; None if nothing of the run is kept on disk but its checkpoints."""
    named = config.replay.root or run.output_dir or progress.checkpoint
    if config.collect.enabled or (named and config.needs_teacher_chunks):
        return find_replay_root(config, run, progress)
    return None


def _journal(
    config: StudentConfig,
    root: Path | None,
    progress: Progress,
    demonstrations: LeRobotDatasetMetadata,
    env_config: EnvConfig,
    seed: int,
) -> EpisodeJournal:
    """The journal of the run's episodes; notes its folder in `progress`."""
    assert root is not None
    progress.replay_root = str(root)
    identity = episode_identity(config, env_config, seed)
    journal = EpisodeJournal(root)
    processes = PartialState()
    if processes.is_main_process:
        journal.begin(demonstrations, identity, resume=progress.checkpoint is not None)
    processes.wait_for_everyone()
    return journal


def _adopt_rounds(
    journal: EpisodeJournal | None, replay: Replay, progress: Progress
) -> tuple[RoundReport, ...]:
    """Take the checkpoint's rounds into T; those finished after it enter T when their step comes again."""
    if journal is None:
        return ()
    reports = tuple(read_reports(journal.root))
    if len(reports) < progress.rounds:
        raise FileNotFoundError(
            f"the checkpoint has used {progress.rounds} collection rounds, {journal.root} holds {len(reports)}; point "
            "--policy.replay.root at the run's folder of collected episodes"
        )
    used, later = reports[: progress.rounds], reports[progress.rounds :]
    for report in used:
        replay.extend(journal.kept(report.round))
    if used:
        logger.info("T holds %d finished rounds of %s", len(used), journal.root)
    if later:
        logger.info("%d finished rounds of %s enter T when training reaches them", len(later), journal.root)
    return used
