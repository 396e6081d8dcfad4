"""What a user can get wrong, and whether the error names the flag, what was found and what would be right."""

from contextlib import nullcontext

import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.envs.configs import PushtEnv
from lerobot.policies import make_pre_post_processors
from small_environment import FittingEnv

from lerobot_agpd.collect.config import CollectConfig, MixingConfig
from lerobot_agpd.distill.environment import check_environment_fits, run_environment
from lerobot_agpd.envs.gymnasium_robotics import GymnasiumRoboticsEnv
from lerobot_agpd.guidance.config import GuidanceConfig, RepresentationConfig, TeacherConfig
from lerobot_agpd.guidance.loading import load_teacher
from lerobot_agpd.policies.agpd.modeling_agpd import AGPDPolicy
from lerobot_agpd.policies.agpd_diffusion.modeling_agpd_diffusion import AGPDDiffusionPolicy
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


# ---- numbers of executed steps ----


@pytest.fixture
def guided_config(agpd_config, save_teacher):
    """An ACT student of the small teacher, which executes 8 steps; the student's chunk has 8, and it executes 4."""

    def config(**options):
        options = {"collect": CollectConfig(env=FittingEnv()), "n_action_steps": 4, **options}
        return agpd_config(teacher=TeacherConfig(path=str(save_teacher())), **options)

    return config


def test_a_representation_that_looks_as_far_ahead_as_rounds_execute(guided_config, demonstrations, tmp_path):
    config = guided_config(representation=RepresentationConfig(type="state", width=16, n_heads=2))
    train_step(config, demonstrations, RunInfo(output_dir=tmp_path))


def test_a_representation_that_looks_further_ahead_than_rounds_execute(
    guided_config, demonstrations, tmp_path
):
    config = guided_config(
        n_action_steps=8,
        chunk_size=16,
        representation=RepresentationConfig(type="state", width=16, n_heads=2),
    )
    config.n_action_steps = 16  # the teacher executes 8
    with pytest.raises(
        ValueError, match=r"predicts 16 steps ahead.*execute 8.*--policy.collect.n_action_steps=8"
    ):
        train_step(config, demonstrations, RunInfo(output_dir=tmp_path))


def test_a_representation_without_a_future_to_learn_from(guided_config, demonstrations, tmp_path):
    config = guided_config(representation=RepresentationConfig(type="state", width=16, n_heads=2))
    config.collect = CollectConfig(env=FittingEnv(), n_action_steps=7)
    with pytest.raises(ValueError, match=r"predicts 7 steps ahead, and no demonstration is longer than 7"):
        train_step(config, demonstrations, RunInfo(output_dir=tmp_path))


def test_a_representation_of_actions_that_were_not_executed(guided_config, demonstrations, tmp_path):
    config = guided_config(
        representation=RepresentationConfig(type="state", width=16, n_heads=2),
        collect=CollectConfig(env=FittingEnv(), strategy="mixing", mixing=MixingConfig(relabel=True)),
    )
    with pytest.raises(ValueError, match=r"--policy.collect.mixing.relabel=true records actions"):
        train_step(config, demonstrations, RunInfo(output_dir=tmp_path))


def test_more_executed_steps_than_a_diffusion_student_returns(
    agpd_diffusion_config, demonstrations, save_teacher, tmp_path
):
    """LeRobot's diffusion policy predicts 8 steps here and returns those that it would execute."""
    config = agpd_diffusion_config(
        teacher=TeacherConfig(path=str(save_teacher())),
        collect=CollectConfig(env=FittingEnv(), n_action_steps=6),
    )
    assert config.n_action_steps < 6
    policy = AGPDDiffusionPolicy(config, demonstrations.meta.stats, demonstrations.meta)
    with (
        declared_run(RunInfo(output_dir=tmp_path)),
        pytest.raises(ValueError, match=r"n_action_steps=6 exceeds.*the student \d, the teacher 15"),
    ):
        policy.distillation  # noqa: B018


# ---- collection ----


def test_rollin_without_guidance_takes_any_teacher(agpd_config, demonstrations, tmp_path):
    config = agpd_config()
    AGPDPolicy(config).save_pretrained(tmp_path / "act")
    for processor in make_pre_post_processors(config, dataset_stats=demonstrations.meta.stats):
        processor.save_pretrained(tmp_path / "act")
    teacher = TeacherConfig(path=str(tmp_path / "act"))
    collect = CollectConfig(env=FittingEnv(), strategy="rollin")
    for scale, refused in ((0.0, False), (0.5, True)):
        config = agpd_config(teacher=teacher, collect=collect, guidance=GuidanceConfig(scale=scale))
        with pytest.raises(ValueError, match="no denoising to guide") if refused else nullcontext():
            train_step(config, demonstrations, RunInfo(output_dir=tmp_path))


@pytest.mark.parametrize(
    ("collect", "said"),
    [
        ({"keep_failures": True}, "--policy.replay.relabel=none: the student imitates the failures"),
        ({"episodes": 4}, "less than one episode"),
    ],
)
def test_what_is_allowed_and_seldom_wanted_is_said(
    guided_config, demonstrations, tmp_path, caplog, collect, said
):
    config = guided_config(collect=CollectConfig(env=FittingEnv(), **collect))
    train_step(config, demonstrations, RunInfo(output_dir=tmp_path))
    assert said in caplog.text


def test_failures_whose_actions_are_the_teachers_need_no_warning(
    guided_config, demonstrations, tmp_path, caplog
):
    mixing = MixingConfig(relabel=True)
    collect = CollectConfig(env=FittingEnv(), strategy="mixing", mixing=mixing, keep_failures=True)
    train_step(guided_config(collect=collect), demonstrations, RunInfo(output_dir=tmp_path))
    assert "imitates the failures" not in caplog.text


@pytest.mark.parametrize(
    ("name", "value"), [("seed", 7), ("strategy", "replay"), ("teacher", "elsewhere"), ("environment", None)]
)
def test_rounds_of_another_run_are_not_adopted(guided_config, demonstrations, tmp_path, name, value):
    config = guided_config()
    policy = AGPDPolicy(config, dataset_meta=demonstrations.meta)
    with declared_run(RunInfo(output_dir=tmp_path)):
        rounds = policy.distillation.rounds
    rounds.check_own(rounds.identity)
    rounds.check_own(
        {key: entry for key, entry in rounds.identity.items() if key != "seed"}
    )  # an older one's
    with pytest.raises(ValueError, match=rf"another run \({name} .* instead of .*--policy.replay.root"):
        rounds.check_own(rounds.identity | {name: value})
