"""What a user can get wrong: each refusal names both sides, when the policy is built and not later."""

import json
import logging

import pytest
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import PushtEnv
from point_environment import PointEnv

from lerobot_agpd.config import (
    AdversaryConfig,
    CollectConfig,
    GuidanceConfig,
    MixingConfig,
    ReplayConfig,
    RepresentationConfig,
    TeacherConfig,
)
from lerobot_agpd.fit import check_fit
from lerobot_agpd.flag_checks import FlagError
from lerobot_agpd.loading import collection_environment, load_teacher, read_policy_config
from lerobot_agpd.policies.agpd.modeling_agpd import AGPDPolicy
from lerobot_agpd.policies.agpd_diffusion.modeling_agpd_diffusion import AGPDDiffusionPolicy
from lerobot_agpd.run import RunInfo

ENV_KEY = "observation.environment_state"


def collect(**options) -> CollectConfig:
    return CollectConfig(env=PointEnv(), **options)


@pytest.fixture
def guided_config(agpd_config, save_teacher):
    """An ACT student of the small teacher, which executes 8 steps; the student's chunk has 8, and it executes 4."""

    def config(**options):
        return agpd_config(**{"teacher": save_teacher(), "collect": collect(), **options})

    return config


# ---- the teacher ----


def test_no_policy_at_the_teachers_path(tmp_path):
    with pytest.raises(FileNotFoundError, match=f"--policy.teacher.path='{tmp_path}'"):
        load_teacher(TeacherConfig(path=str(tmp_path)), "cpu")
    with pytest.raises(FileNotFoundError, match="--policy.path='nowhere/x'"):
        read_policy_config("nowhere/x", "--policy.path")


@pytest.mark.parametrize(
    ("strategy", "scale", "refused"),
    [("guided", 0.5, True), ("rollin", 0.5, True), ("rollin", 0.0, False), ("teacher", 0.5, False)],
)
def test_a_teacher_that_does_not_denoise_cannot_be_guided(
    build, agpd_config, save_policy, strategy, scale, refused
):
    config = agpd_config(
        teacher=save_policy(AGPDPolicy(agpd_config())),
        collect=collect(strategy=strategy),
        guidance=GuidanceConfig(scale=scale),
    )
    if not refused:
        build(config)
        return
    with pytest.raises(FlagError, match="'agpd' teacher.*--policy.collect.strategy=teacher"):
        build(config)


@pytest.mark.parametrize("strategy", ["guided", "rollin"])
@pytest.mark.parametrize("guidance", [{}, {"scale": 0.5}])
def test_a_teacher_that_denoises_in_one_step_cannot_be_guided(build, guided_config, strategy, guidance):
    config = guided_config(collect=collect(strategy=strategy), guidance=GuidanceConfig(**guidance))
    config.teacher.num_inference_steps = 1
    with pytest.raises(FlagError, match=r"^--policy.teacher.num_inference_steps=1: .* variance, which is 0"):
        build(config)
    config.collect.strategy = "teacher"
    build(config)


def test_a_pull_that_the_teachers_steps_cannot_follow(build, guided_config):
    config = guided_config(guidance=GuidanceConfig(pull=0.6))
    config.teacher.num_inference_steps = 2
    refusal = r"^--policy.guidance.pull=0.6 is out of reach: the 2 denoising steps .* by at most 0.0\d"
    with pytest.raises(FlagError, match=refusal):
        build(config)
    config.guidance = GuidanceConfig(scale=0.5)
    build(config)


def test_a_student_that_teaches_itself_in_one_step(build, agpd_diffusion_config):
    config = agpd_diffusion_config(collect=collect(), adversary=AdversaryConfig(weight=0))
    config.num_inference_steps = 1
    with pytest.raises(FlagError, match=r"^--policy.num_inference_steps=1: "):
        build(config, AGPDDiffusionPolicy)


# ---- what must fit together ----


@pytest.fixture
def wide():
    return PolicyFeature(FeatureType.ENV, (16,))


def test_a_teacher_with_other_observations(build, agpd_config, save_teacher, input_features, wide):
    config = agpd_config(
        teacher=save_teacher(inputs={**input_features, ENV_KEY: wide}), collect=CollectConfig(every=0)
    )
    with pytest.raises(FlagError) as refusal:
        build(config)
    for part in ("--policy.teacher.path", "(16,)", "--dataset.*", "(3,)", f"differ in ['{ENV_KEY}']"):
        assert part in str(refusal.value)


def test_a_teacher_with_other_actions(build, agpd_config, save_teacher):
    five = {"action": PolicyFeature(FeatureType.ACTION, (5,))}
    with pytest.raises(FlagError, match=r"--policy.teacher.path.*\(5,\), the student's \(2,\)"):
        build(agpd_config(teacher=save_teacher(outputs=five), collect=collect()))


def test_no_environment(build, agpd_config, save_teacher):
    with pytest.raises(FlagError, match=r"--env.type=.*--policy.collect.env.type=.*--policy.collect.every=0"):
        build(agpd_config(teacher=save_teacher()))


def test_the_policys_own_environment_comes_first():
    own, other = PointEnv(), PushtEnv()
    assert collection_environment(CollectConfig(env=own), RunInfo(env=other)) is own
    assert collection_environment(CollectConfig(), RunInfo(env=other)) is other


def test_an_environment_without_the_demonstrated_observations(build, guided_config):
    pixels = CollectConfig(env=PushtEnv(obs_type="pixels_agent_pos"))
    with pytest.raises(FlagError, match=rf"student observes.*'pusht' delivers.*{ENV_KEY}.*--env.obs_type"):
        build(guided_config(collect=pixels))


def test_an_environment_with_other_shapes(build, guided_config):
    keypoints = CollectConfig(env=PushtEnv(obs_type="environment_state_agent_pos"))
    with pytest.raises(FlagError, match=rf"'{ENV_KEY}' has shape \(3,\).*--dataset.*\(16,\).*'pusht'"):
        build(guided_config(collect=keypoints))


def test_an_environment_with_other_actions(build, guided_config):
    env = PointEnv()
    env.features["action"] = PolicyFeature(FeatureType.ACTION, (7,))
    with pytest.raises(FlagError, match=r"'action' has shape \(2,\).*\(7,\).*'agpd_test_point'"):
        build(guided_config(collect=CollectConfig(env=env)))


def test_an_environment_at_another_rate(build, guided_config):
    with pytest.raises(FlagError, match=r"--dataset.*at 10 frames.*--env.fps\) runs at 25"):
        build(guided_config(collect=CollectConfig(env=PointEnv(fps=25))))


def test_a_teacher_and_an_environment_without_demonstrations(agpd_config, save_teacher, input_features, wide):
    """As in commands that roll out what was trained."""
    teacher = load_teacher(save_teacher(), "cpu")
    config = agpd_config()
    check_fit(config, teacher, env_config=PointEnv())
    other = load_teacher(save_teacher(inputs={**input_features, ENV_KEY: wide}), "cpu")
    with pytest.raises(FlagError, match=r"\(16,\).*'agpd_test_point' \(--env.*\(3,\)"):
        check_fit(config, other, env_config=PointEnv())
    more = load_teacher(save_teacher(inputs={**input_features, "observation.effort": wide}), "cpu")
    with pytest.raises(FlagError, match=r"teacher observes.*'agpd_test_point'.*observation.effort"):
        check_fit(config, more, env_config=PointEnv())


# ---- numbers of executed steps ----


def test_a_representation_that_looks_as_far_ahead_as_rounds_execute(build, guided_config):
    build(guided_config(representation=RepresentationConfig("state")))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"n_action_steps": 16, "chunk_size": 16},  # the teacher executes 8
            "predicts 16 steps ahead.*execute 8.*--policy.collect.n_action_steps=8",
        ),
        ({"collect": collect(n_action_steps=7)}, "7 steps ahead.*no demonstration is longer than 7"),
        (
            {"collect": collect(strategy="mixing", mixing=MixingConfig(record_teacher=True))},
            "--policy.collect.mixing.record_teacher=true",
        ),
    ],
)
def test_a_representation_that_could_not_be_learned(build, guided_config, options, message):
    with pytest.raises(FlagError, match=message):
        build(guided_config(representation=RepresentationConfig("state"), **options))


def test_more_executed_steps_than_a_diffusion_student_returns(build, agpd_diffusion_config, save_teacher):
    """LeRobot's diffusion policy predicts 8 steps here and returns the 4 that it would execute."""
    config = agpd_diffusion_config(teacher=save_teacher(), collect=collect(n_action_steps=6))
    with pytest.raises(FlagError, match=r"n_action_steps=6 .*the student 4, the teacher 15"):
        policy = build(config, AGPDDiffusionPolicy)
        policy.agpd.grow()


# ---- what is allowed and seldom intended ----


@pytest.mark.parametrize(
    ("options", "flag"),
    [
        ({"keep_failures": True}, "--policy.replay.relabel=none"),
        ({"keep_failures": True, "strategy": "mixing", "mixing": MixingConfig(record_teacher=True)}, None),
        ({"episodes": 4}, "--policy.collect.teacher_only_fraction=0.2"),
        ({"episodes": 4, "strategy": "teacher"}, None),
        ({}, None),
    ],
)
def test_warnings(build, guided_config, caplog, options, flag):
    caplog.set_level(logging.WARNING)
    build(guided_config(collect=collect(**options)))
    warnings = [record.getMessage() for record in caplog.records if "before_training" in record.name]
    assert [flag in warning for warning in warnings] == ([] if flag is None else [True])


# ---- the folder of episodes ----


def test_episodes_of_another_run_are_not_adopted(build, guided_config, tmp_path):
    first = build(guided_config())
    build(guided_config())  # the same run again
    with pytest.raises(ValueError, match="another run.*strategy 'guided' instead of 'teacher'.*replay.root"):
        build(guided_config(collect=collect(strategy="teacher")))
    elsewhere = guided_config(collect=collect(strategy="teacher"), replay=ReplayConfig(str(tmp_path / "x")))
    assert build(elsewhere).agpd.journal.root == tmp_path / "x" != first.agpd.journal.root


OTHER_EPISODES = [
    ({"guidance": GuidanceConfig(pull=0.3, at="mu")}, "guidance.at 'x0' instead of 'mu'"),
    ({"guidance": GuidanceConfig(pull=0.1)}, "guidance.pull None instead of 0.1"),
    ({"collect": collect(min_reward=0.5)}, "collect.min_reward None instead of 0.5"),
    ({"collect": collect(keep_failures=True)}, "collect.keep_failures False instead of True"),
    ({"collect": collect(n_action_steps=2)}, "collect.n_action_steps None instead of 2"),
]


@pytest.mark.parametrize(("options", "difference"), OTHER_EPISODES)
def test_episodes_made_with_other_settings_are_not_adopted(build, guided_config, options, difference):
    build(guided_config())
    with pytest.raises(ValueError, match=f"another run.*{difference}.*--policy.replay.root"):
        build(guided_config(**options))


def test_episodes_of_another_sampler_are_not_adopted(build, guided_config):
    config = guided_config()
    build(config)
    config.teacher.num_inference_steps = 7
    with pytest.raises(ValueError, match="teacher.num_inference_steps None instead of 7"):
        build(config)


@pytest.mark.parametrize("changed", [False, True])
def test_a_resumed_run_with_other_settings_warns(build, guided_config, tmp_path, caplog, changed):
    folder = tmp_path / "run" / "checkpoints" / "000001" / "pretrained_model"
    build(guided_config()).save_pretrained(folder)
    config = guided_config(**({"collect": collect(min_reward=0.5)} if changed else {}))
    config.pretrained_path = folder
    build(config, resume=True)
    warnings = [record.getMessage() for record in caplog.records if "other settings" in record.getMessage()]
    assert ["collect.min_reward None instead of 0.5" in warning for warning in warnings] == [True] * changed


@pytest.mark.parametrize(
    ("state", "error", "message"),
    [
        (None, FileNotFoundError, "agpd_state.json is missing.*--policy.path"),
        ({"updates": 5}, ValueError, "another version"),
        (
            {"step": 5, "rounds": 2, "replay_root": None, "seen_episodes": [], "reference_frames": []},
            FileNotFoundError,
            "2 collection rounds.*holds 0.*--policy.replay.root",
        ),
    ],
)
def test_a_run_that_cannot_be_resumed(build, guided_config, tmp_path, state, error, message):
    config = guided_config()
    config.pretrained_path = tmp_path / "run" / "checkpoints" / "000001" / "pretrained_model"
    build(guided_config()).save_pretrained(config.pretrained_path)
    file = config.pretrained_path / "agpd_state.json"
    file.unlink() if state is None else file.write_text(json.dumps(state))
    with pytest.raises(error, match=message):
        build(config, resume=True)
