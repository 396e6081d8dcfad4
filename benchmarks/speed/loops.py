"""LeRobot's training loop, one step at a time: what `lerobot_train.train` builds, built from its own parts."""

from __future__ import annotations

import tempfile
from pathlib import Path

import draccus
import torch
from accelerate import Accelerator
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets import EpisodeAwareSampler
from lerobot.datasets.factory import make_train_eval_datasets
from lerobot.optim.factory import make_optimizer_and_scheduler
from lerobot.policies import PreTrainedPolicy, make_policy, make_pre_post_processors
from lerobot.scripts.lerobot_train import update_policy
from lerobot.utils.logging_utils import AverageMeter, MetricsTracker
from lerobot.utils.random_utils import set_seed
from lerobot.utils.utils import cycle

EXAMPLES = Path(__file__).parents[2] / "examples"
PICK_AND_PLACE = EXAMPLES / "fetch_pick_and_place"
METERS = ("loss", "grad_norm", "lr", "update_s", "dataloading_s", "gpu_mem_gb")
BATCH_SIZE = 64


def train_config(*flags: str, preset: str | None = None, dataset: Path | None = None) -> TrainPipelineConfig:
    """What `lerobot-train` would parse, on the demonstrations of FetchPickAndPlace unless told otherwise."""
    root = dataset or PICK_AND_PLACE / "demonstrations"
    common = [f"--dataset.root={root}", "--dataset.repo_id=local/speed", "--policy.push_to_hub=false"]
    common += [f"--output_dir={tempfile.mkdtemp()}/run", "--steps=100000", f"--batch_size={BATCH_SIZE}"]
    path = EXAMPLES / "presets" / f"{preset}.yaml" if preset else None
    config = draccus.parse(
        TrainPipelineConfig, config_path=path, args=[*common, "--num_workers=0", "--env_eval_freq=0", *flags]
    )
    config.validate()
    return config


class Loop:
    """A training run that is stepped from outside."""

    def __init__(self, config: TrainPipelineConfig):
        set_seed(config.seed)
        self.config = config
        self.policy, dataset = self._build(config)
        self.accelerator = Accelerator(step_scheduler_with_optimizer=False, cpu=config.policy.device == "cpu")
        self.preprocessor, self.postprocessor = make_pre_post_processors(
            config.policy, dataset_stats=dataset.meta.stats
        )
        optimizer, scheduler = make_optimizer_and_scheduler(config, self.policy)
        sampler = EpisodeAwareSampler(
            dataset.meta.episodes["dataset_from_index"],
            dataset.meta.episodes["dataset_to_index"],
            drop_n_last_frames=getattr(config.policy, "drop_n_last_frames", 0),
            shuffle=True,
            seed=config.seed or 0,
        )
        loader = torch.utils.data.DataLoader(dataset, batch_size=config.batch_size, sampler=sampler)
        self.model, self.optimizer, loader, self.scheduler = self.accelerator.prepare(
            self.policy, optimizer, loader, scheduler
        )
        self._batches = cycle(loader)
        meters = {name: AverageMeter(name) for name in METERS}
        self._tracker = MetricsTracker(config.batch_size, dataset.num_frames, dataset.num_episodes, meters)
        self.model.train()

    @staticmethod
    def _build(config: TrainPipelineConfig) -> tuple[PreTrainedPolicy, torch.utils.data.Dataset]:
        # The names are those of `lerobot_train.train`: a policy looks for its run among them.
        cfg = config
        dataset, _ = make_train_eval_datasets(cfg)
        policy = make_policy(cfg=cfg.policy, ds_meta=dataset.meta)
        return policy, dataset

    def batch(self) -> dict:
        """The next batch, as the policy's forward gets it."""
        return self.preprocessor(next(self._batches))

    def step(self) -> None:
        """One pass of the loop."""
        update_policy(
            self._tracker,
            self.model,
            self.batch(),
            self.optimizer,
            self.config.optimizer.grad_clip_norm,
            accelerator=self.accelerator,
            lr_scheduler=self.scheduler,
        )


class Floor:
    """A network and its optimizer on a fixed batch, nothing else."""

    def __init__(self, policy: PreTrainedPolicy, batch: dict, clip: float = 10.0):
        self.policy, self.fixed, self.clip = policy.train(), batch, clip
        self.parameters = [parameter for parameter in policy.parameters() if parameter.requires_grad]
        self.optimizer = torch.optim.AdamW(self.parameters, lr=1e-4, fused=True)

    def step(self) -> None:
        loss, _ = self.policy.forward(dict(self.fixed))
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.parameters, self.clip)
        self.optimizer.step()
        self.optimizer.zero_grad()
