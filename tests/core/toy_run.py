"""A run of a few steps with the toy teacher, through the hooks that LeRobot's training loop calls."""

import numpy as np
import torch
from lerobot.policies import make_pre_post_processors

from lerobot_agpd.policies.agpd.modeling_agpd import AGPDPolicy

STEPS, EPISODES, TEACHER_ONLY, SCALE = 10, 6, 2, 0.25
ROUND_STEPS = [3, 6, 9]

STUDENT: dict[str, object] = {}
"""Settings of the student beside those of tests/conftest.py."""


class Run:
    """A run of a few steps through the hooks that LeRobot's training loop calls."""

    def __init__(self, policy: AGPDPolicy, dataset):
        self.policy, self.dataset, self.logs = policy.train(), dataset, []
        self.optimizer = torch.optim.AdamW(policy.get_optim_params(), lr=1e-4)
        self.processors = make_pre_post_processors(policy.config, dataset_stats=dataset.meta.stats)

    @property
    def agpd(self):
        return self.policy.agpd

    def batch(self):
        frames = torch.utils.data.default_collate([self.dataset[n] for n in range(0, len(self.dataset), 2)])
        return self.processors[0](frames)

    def train(self, until: int) -> "Run":
        """Train until so many steps are done."""
        while self.agpd.progress.step < until:
            self.policy.train()
            for _ in range(self.agpd.run.steps_per_update):
                loss, log = self.policy.forward(self.batch())
                loss.backward()
                self.logs.append({"loss": loss.item(), **log})
            self.optimizer.step()
            self.optimizer.zero_grad()
            self.policy.update()
        return self

    def save(self) -> "Run":
        """Save a checkpoint where LeRobot would."""
        self.policy.save_pretrained(self.checkpoint)
        for processor in self.processors:
            processor.save_pretrained(self.checkpoint)
        return self

    @property
    def checkpoint(self):
        step = f"{self.agpd.progress.step:06d}"
        return self.agpd.run.output_dir / "checkpoints" / step / "pretrained_model"

    def records(self, round_number):
        return self.agpd.journal.records(round_number)


def episodes_on_disk(agpd) -> dict[str, np.ndarray]:
    return {str(path): np.load(path) for path in sorted(agpd.journal.root.rglob("*.npy"))}
