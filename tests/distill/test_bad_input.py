"""What a user can get wrong, and whether the error names the flag, what was found and what would be right."""

import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.envs.configs import PushtEnv
from lerobot.policies import make_pre_post_processors

from lerobot_agpd.collect.config import CollectConfig
from lerobot_agpd.distill.environment import check_environment_fits, run_environment
from lerobot_agpd.envs.gymnasium_robotics import GymnasiumRoboticsEnv
from lerobot_agpd.guidance.config import GuidanceConfig, TeacherConfig
from lerobot_agpd.guidance.loading import load_teacher
from lerobot_agpd.policies.agpd.modeling_agpd import AGPDPolicy
from lerobot_agpd.run import RunInfo, declared_run


def train_step(config, dataset: LeRobotDataset, run: RunInfo) -> None:
    """The first forward of `lerobot-train` on two frames of the dataset."""
    policy = AGPDPolicy(config, dataset_stats=dataset.meta.stats, dataset_meta=dataset.meta).train()
    preprocessor, _ = make_pre_post_processors(config, dataset_stats=dataset.meta.stats)
    frames = torch.utils.data.default_collate([dataset[0], dataset[6]])
    with declared_run(run):
        policy.forward(preprocessor(frames))


def test_no_teacher(agpd_config, demonstrations):
    with pytest.raises(ValueError, match=r"--policy.teacher.path is not set.*--policy.collect.every=0"):
        train_step(agpd_config(), demonstrations, RunInfo(env=PushtEnv()))


def test_teacher_path_without_a_policy(tmp_path):
    with pytest.raises(FileNotFoundError, match="--policy.teacher.path=.*neither a folder"):
        load_teacher(TeacherConfig(path=str(tmp_path)), "cpu")


def test_guiding_a_teacher_that_does_not_denoise(tmp_path, agpd_config, demonstrations):
    config = agpd_config()
    AGPDPolicy(config).save_pretrained(tmp_path / "act")
    for processor in make_pre_post_processors(config, dataset_stats=demonstrations.meta.stats):
        processor.save_pretrained(tmp_path / "act")
    config = agpd_config(teacher=TeacherConfig(path=str(tmp_path / "act")))
    with pytest.raises(ValueError, match=r"'agpd' teacher .*no denoising to guide.*strategy=replay"):
        train_step(config, demonstrations, RunInfo(env=PushtEnv()))


def test_teacher_with_other_observations(agpd_config, demonstrations, save_teacher, input_features):
    wider = {**input_features, "observation.environment_state": PolicyFeature(FeatureType.ENV, (16,))}
    config = agpd_config(teacher=TeacherConfig(path=str(save_teacher(inputs=wider))))
    with pytest.raises(ValueError, match=r"the teacher .* needs .*\(16,\).*hold .*\(3,\)"):
        train_step(config, demonstrations, RunInfo(env=PushtEnv()))


def test_teacher_with_other_actions(agpd_config, demonstrations, save_teacher):
    other = {"action": PolicyFeature(FeatureType.ACTION, (5,))}
    config = agpd_config(teacher=TeacherConfig(path=str(save_teacher(outputs=other))))
    with pytest.raises(
        ValueError, match=r"the teacher's actions have shape \(5,\), the demonstrations' \(2,\)"
    ):
        train_step(config, demonstrations, RunInfo(env=PushtEnv()))


def test_too_many_denoising_steps(save_teacher):
    with pytest.raises(ValueError, match="num_inference_steps=500 exceeds the 100"):
        load_teacher(TeacherConfig(path=str(save_teacher()), num_inference_steps=500), "cpu")


def test_no_environment():
    with pytest.raises(ValueError, match=r"--env.type=.*--policy.collect.env.type="):
        run_environment(CollectConfig(), RunInfo())


def test_the_policys_own_environment_comes_first():
    own = PushtEnv(obs_type="environment_state_agent_pos")
    assert run_environment(CollectConfig(env=own), RunInfo(env=GymnasiumRoboticsEnv())) is own


def test_environment_without_the_demonstrated_observations(agpd_config, save_teacher):
    teacher = load_teacher(TeacherConfig(path=str(save_teacher())), "cpu")
    pixels = PushtEnv(obs_type="pixels_agent_pos")
    with pytest.raises(
        ValueError, match=r"\['observation.environment_state'\] is missing \(check --env.obs_type"
    ):
        check_environment_fits(pixels, agpd_config(), teacher)


def test_environment_with_other_shapes(agpd_config, save_teacher):
    teacher = load_teacher(TeacherConfig(path=str(save_teacher())), "cpu")
    keypoints = PushtEnv(obs_type="environment_state_agent_pos")  # 16 numbers; the demonstrations have 3
    with pytest.raises(
        ValueError, match=r"'observation.environment_state' has shape \(3,\).*\(16,\).*'pusht'"
    ):
        check_environment_fits(keypoints, agpd_config(), teacher)


def test_more_executed_steps_than_the_student_predicts(agpd_config):
    with pytest.raises(ValueError, match=r"--policy.collect.n_action_steps=9 exceeds.*--policy.chunk_size=8"):
        agpd_config(collect=CollectConfig(n_action_steps=9))


class FittingEnv(PushtEnv):
    """An environment configuration with the features of the small dataset."""

    def __post_init__(self):
        self.features = {
            "agent_pos": PolicyFeature(FeatureType.STATE, (2,)),
            "environment_state": PolicyFeature(FeatureType.ENV, (3,)),
            "action": PolicyFeature(FeatureType.ACTION, (2,)),
        }


def test_resuming_without_the_collected_episodes(agpd_config, demonstrations, save_teacher, tmp_path):
    checkpoint = tmp_path / "run" / "checkpoints" / "000001" / "pretrained_model"
    checkpoint.mkdir(parents=True)
    (checkpoint / "agpd_state.json").write_text('{"updates": 5, "rounds": 2, "seen_episodes": []}')
    config = agpd_config(
        teacher=TeacherConfig(path=str(save_teacher())), collect=CollectConfig(env=FittingEnv())
    )
    config.pretrained_path = checkpoint
    policy = AGPDPolicy(config, dataset_meta=demonstrations.meta)
    run = RunInfo(resume=True, output_dir=tmp_path / "elsewhere")
    with (
        declared_run(run),
        pytest.raises(FileNotFoundError, match=r"used 2 collection rounds.*holds 0.*--policy.replay.root"),
    ):
        policy.distillation  # noqa: B018


@pytest.mark.parametrize(
    ("group", "options", "flag"),
    [
        (CollectConfig, {"strategy": "magic"}, "--policy.collect.strategy"),
        (CollectConfig, {"episodes": 0}, "--policy.collect.episodes"),
        (CollectConfig, {"unguided_fraction": 1.5}, "--policy.collect.unguided_fraction"),
        (CollectConfig, {"push_to_hub": True}, "--policy.collect.repo_id"),
        (GuidanceConfig, {"scale": -1.0}, "--policy.guidance.scale"),
        (GuidanceConfig, {"at": "eps"}, "--policy.guidance.at"),
        (GuidanceConfig, {"growth": 1.0}, "--policy.guidance.growth"),
        (TeacherConfig, {"noise_scheduler": "Euler"}, "--policy.teacher.noise_scheduler"),
    ],
)
def test_flags_are_checked_when_parsed(group, options, flag):
    with pytest.raises(ValueError, match=flag):
        group(**options)
