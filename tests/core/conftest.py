"""A small teacher on disk, and the first steps of a training loop."""

from pathlib import Path

import pytest
import torch
import toy_run
from lerobot.common.train_utils import save_checkpoint
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.policies import make_pre_post_processors
from point_environment import PointEnv, PointTeacher, demonstrate
from small_dataset import create_dataset
from toy_run import EPISODES, ROUND_STEPS, SCALE, STEPS, TEACHER_ONLY, Run

from lerobot_agpd import build as builders
from lerobot_agpd.config import AdversaryConfig, CollectConfig, GuidanceConfig, ReplayConfig, TeacherConfig
from lerobot_agpd.policies.agpd.modeling_agpd import AGPDPolicy
from lerobot_agpd.policies.diffusion_transformer.configuration_diffusion_transformer import (
    DiffusionTransformerConfig,
    MLPDenoiserConfig,
)
from lerobot_agpd.policies.diffusion_transformer.modeling_diffusion_transformer import (
    DiffusionTransformerPolicy,
)
from lerobot_agpd.run import RunInfo


@pytest.fixture
def save_policy(tmp_path, demonstrations):
    """Writes a policy with its processors, and names its folder as a teacher."""

    def save(policy) -> TeacherConfig:
        folder: Path = tmp_path / policy.name
        policy.save_pretrained(folder)
        for processor in make_pre_post_processors(policy.config, dataset_stats=demonstrations.meta.stats):
            processor.save_pretrained(folder)
        return TeacherConfig(path=str(folder))

    return save


@pytest.fixture
def save_teacher(save_policy, input_features, output_features):
    """Writes a random diffusion teacher (chunks of 16 steps, one of them past); features can be exchanged."""

    def save(inputs=None, outputs=None) -> TeacherConfig:
        config = DiffusionTransformerConfig(
            input_features=inputs or dict(input_features),
            output_features=outputs or dict(output_features),
            mlp=MLPDenoiserConfig(width=8, n_blocks=1),
            num_inference_steps=5,
            noise_scheduler_type="DDIM",
            device="cpu",
            push_to_hub=False,
        )
        return save_policy(DiffusionTransformerPolicy(config))

    return save


@pytest.fixture
def build(demonstrations, tmp_path):
    """Builds a policy as a training run does."""

    def build(config, policy_class=AGPDPolicy, dataset=demonstrations, **facts):
        run = RunInfo(**{"output_dir": tmp_path / "run", **facts})
        return policy_class(config, dataset.meta.stats, dataset.meta, run=run).train()

    return build


@pytest.fixture
def loop_batch(demonstrations):
    """What `lerobot-train` hands to a policy's forward for given frames of a dataset."""

    def batch(config, frames, dataset=demonstrations):
        preprocessor, _ = make_pre_post_processors(config, dataset_stats=dataset.meta.stats)
        return preprocessor(torch.utils.data.default_collate([dataset[frame] for frame in frames]))

    return batch


NO_ROUNDS = CollectConfig(every=0)
NO_ADVERSARY = AdversaryConfig(weight=0)


# ---- runs with the toy teacher of point_environment ----


@pytest.fixture(scope="module")
def point_demonstrations(tmp_path_factory):
    return demonstrate(create_dataset(tmp_path_factory.mktemp("data") / "point"), 3)


@pytest.fixture
def toy_teacher(monkeypatch):
    """The teacher that every run loads."""
    teacher = PointTeacher()
    monkeypatch.setattr(builders, "load_teacher", lambda config, device: teacher)
    return teacher


@pytest.fixture
def start(agpd_config, point_demonstrations, toy_teacher, tmp_path):
    """Starts a run with the toy teacher, or continues one from its checkpoint; `facts` are those of the run."""

    def start(checkpoint=None, collect=None, guidance=None, root=None, **facts) -> Run:
        torch.manual_seed(0)
        config = agpd_config(
            **toy_run.STUDENT,
            replay=ReplayConfig(root and str(root)),
            teacher=TeacherConfig(path="a/toy"),
            guidance=GuidanceConfig(**{"scale": SCALE, **(guidance or {})}),
            adversary=AdversaryConfig(start=2),
            collect=CollectConfig(
                **{
                    "warmup": ROUND_STEPS[0],
                    "every": 3,
                    "episodes": EPISODES,
                    "n_envs": 3,
                    "diagnostics": False,
                    "teacher_only_fraction": TEACHER_ONLY / EPISODES,
                    **(collect or {}),
                }
            ),
        )
        run = RunInfo(
            **{"output_dir": tmp_path / "run", "env": PointEnv(), "steps": STEPS, **facts},
            resume=checkpoint is not None,
        )
        meta = point_demonstrations.meta
        options = {"dataset_stats": meta.stats, "dataset_meta": meta, "run": run}
        if checkpoint is None:
            return Run(AGPDPolicy(config, **options), point_demonstrations)
        config.pretrained_path = checkpoint
        policy = AGPDPolicy.from_pretrained(checkpoint, config=config, **options)
        return Run(policy, point_demonstrations)

    return start


@pytest.fixture
def save(start, tmp_path):
    """Saves a checkpoint of a toy run, by LeRobot's own function."""

    def save(step=2):
        run = start(steps=50)
        run.agpd.progress.step = step
        folder = tmp_path / "run" / "checkpoints" / f"{step:06d}"
        dataset = DatasetConfig(repo_id="local/point")
        config = TrainPipelineConfig(dataset=dataset, policy=run.policy.config, output_dir=tmp_path / "run")
        config.policy.collect.env = None
        save_checkpoint(folder, step, config, run.policy, run.optimizer, None, *run.processors)
        return folder

    return save


@pytest.fixture
def output_dir(tmp_path):
    (tmp_path / "run" / "agpd").mkdir(parents=True, exist_ok=True)
    return tmp_path / "run"
