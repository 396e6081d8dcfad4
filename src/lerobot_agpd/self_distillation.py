"""Self-distillation (Table 1): a diffusion student teaches itself, guided toward its previous self."""

from __future__ import annotations

from pathlib import Path

from lerobot.policies import PreTrainedPolicy, make_pre_post_processors
from safetensors.torch import load_file, save_file

from lerobot_agpd.guidance.adapters import as_teacher
from lerobot_agpd.guidance.teacher import Teacher
from lerobot_agpd.replay.normalization import Statistics
from lerobot_agpd.student import Student

PREVIOUS_SELF = "previous_self.safetensors"


class SelfTeacher:
    """Snapshots of a student: the newest one acts as teacher, the one before proposes.

    A snapshot holds the weights the student would be evaluated with (averaged ones, if it averages). It is taken
    at the beginning of every round.

    Args:
        student: the policy in training.

    Attributes:
        previous: the snapshot that proposes; None until two have been taken.
    """

    def __init__(self, student: Student):
        self.student = student
        self.previous: PreTrainedPolicy | None = None
        self._newest: PreTrainedPolicy | None = None

    def refresh(self, stats: Statistics) -> Teacher:
        """Take a snapshot and make it the teacher; the last one becomes the previous self.

        Args:
            stats: statistics that the student trains with.
        """
        self.previous = self._newest
        self._newest = self.student.snapshot()
        return self._as_teacher(self._newest, stats)

    def unchanged(self, stats: Statistics) -> Teacher:
        """The student as it is now as a teacher, without a snapshot: how it samples is known before training."""
        assert isinstance(self.student, PreTrainedPolicy)
        return self._as_teacher(self.student, stats)

    def _as_teacher(self, policy: PreTrainedPolicy, stats: Statistics) -> Teacher:
        processors = make_pre_post_processors(
            self.student.config, dataset_stats={key: dict(entry) for key, entry in stats.items()}
        )
        return as_teacher(policy, *processors)

    def save(self, folder: Path) -> None:
        """Write the newest snapshot beside a checkpoint: it is the previous self of the next round."""
        if self._newest is not None:
            weights = {key: value.contiguous().cpu() for key, value in self._newest.state_dict().items()}
            save_file(weights, folder / PREVIOUS_SELF)

    def restore(self, folder: Path) -> None:
        """Read what `save` wrote; without it (no round was collected yet) there is no previous self."""
        if (folder / PREVIOUS_SELF).is_file():
            self._newest = self.student.snapshot()
            self._newest.load_state_dict(load_file(folder / PREVIOUS_SELF))
