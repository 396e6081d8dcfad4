"""Distill a student on FetchReach from Python, offline, on a CPU: demonstrations, teacher, student.

Usage: python examples/train_fetchreach.py

`train` takes everything from the configuration, with one exception: to resume, LeRobot wants `--config_path=<checkpoint>`
in `sys.argv`, as well as `TrainPipelineConfig.from_pretrained(<checkpoint>)` with `resume = True`.
"""

from pathlib import Path

from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.scripts.lerobot_train import train

from lerobot_agpd.cli.demos import DemosConfig, record_demos
from lerobot_agpd.config import AdversaryConfig, CollectConfig, TeacherConfig
from lerobot_agpd.envs.gymnasium_robotics import GymnasiumRoboticsEnv
from lerobot_agpd.policies.agpd.configuration_agpd import AGPDConfig
from lerobot_agpd.policies.diffusion_transformer.configuration_diffusion_transformer import (
    DiffusionTransformerConfig,
    MLPDenoiserConfig,
)


def main(output: Path = Path("outputs/fetchreach")) -> None:
    env = GymnasiumRoboticsEnv(task="FetchReach-v4")
    record_demos(DemosConfig(root=output / "demonstrations", env=env, episodes=20))
    dataset = DatasetConfig(repo_id="local/fetchreach", root=str(output / "demonstrations"))
    loop = {"dataset": dataset, "batch_size": 32, "num_workers": 0, "log_freq": 50, "env_eval_freq": 0}
    local = {"device": "cpu", "push_to_hub": False, "optimizer_lr": 1e-3}

    mlp = MLPDenoiserConfig(width=128, n_blocks=2)
    sampler = {"prediction_type": "sample", "noise_scheduler_type": "DDIM", "num_inference_steps": 5}
    teacher = DiffusionTransformerConfig(
        denoiser="mlp", mlp=mlp, scheduler_warmup_steps=20, **sampler, **local
    )
    train(TrainPipelineConfig(policy=teacher, output_dir=output / "teacher", steps=400, **loop))

    student = AGPDConfig(
        teacher=TeacherConfig(path=str(output / "teacher/checkpoints/last/pretrained_model")),
        collect=CollectConfig(warmup=100, every=50, rounds=2, episodes=10),
        adversary=AdversaryConfig(start=100, every=4),
        **{"chunk_size": 16, "n_action_steps": 8, "dim_model": 64, "dim_feedforward": 128, "use_vae": False},
        **local,
    )
    train(TrainPipelineConfig(policy=student, env=env, output_dir=output / "student", steps=200, **loop))


if __name__ == "__main__":
    main()
