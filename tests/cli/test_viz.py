"""`lerobot-agpd-viz`, end to end on Push-T with random policies."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import PushtEnv
from lerobot.policies import make_pre_post_processors
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE

from lerobot_agpd.cli import viz
from lerobot_agpd.distill.loading import load_student
from lerobot_agpd.guidance.config import TeacherConfig
from lerobot_agpd.policies.agpd.configuration_agpd import AGPDConfig
from lerobot_agpd.policies.agpd.modeling_agpd import AGPDPolicy
from lerobot_agpd.policies.agpd.processor_agpd import make_agpd_pre_post_processors
from lerobot_agpd.policies.diffusion_transformer.configuration_diffusion_transformer import (
    DiffusionTransformerConfig,
)
from lerobot_agpd.policies.diffusion_transformer.modeling_diffusion_transformer import (
    DiffusionTransformerPolicy,
)
from lerobot_agpd.policies.diffusion_transformer.processor_diffusion_transformer import (
    make_diffusion_transformer_pre_post_processors,
)

pytest.importorskip("gym_pusht")
RrdReader = pytest.importorskip("rerun.experimental").RrdReader

INPUTS = {
    OBS_STATE: PolicyFeature(type=FeatureType.STATE, shape=(2,)),
    OBS_ENV_STATE: PolicyFeature(type=FeatureType.ENV, shape=(16,)),
}
OUTPUTS = {ACTION: PolicyFeature(type=FeatureType.ACTION, shape=(2,))}
STATS = {
    key: {
        "min": torch.zeros(dim),
        "max": torch.full((dim,), 512.0),
        "mean": torch.full((dim,), 256.0),
        "std": torch.full((dim,), 100.0),
    }
    for key, dim in ((OBS_STATE, 2), (OBS_ENV_STATE, 16), (ACTION, 2))
}
N_STEPS, EPISODE_LENGTH = 4, 10


def save(policy, processors, path: Path) -> Path:
    policy.save_pretrained(path)
    for processor in processors:
        processor.save_pretrained(path)
    return path


@pytest.fixture(scope="module")
def teacher(tmp_path_factory) -> Path:
    config = DiffusionTransformerConfig(
        prediction_type="epsilon",  # a random predictor of clean chunks would not feel the pull
        input_features=INPUTS,
        output_features=OUTPUTS,
        device="cpu",
        push_to_hub=False,
        horizon=8,
        n_action_steps=N_STEPS,
        drop_n_last_frames=3,
        num_train_timesteps=20,
        num_inference_steps=5,
    )
    config.mlp.width, config.mlp.n_blocks = 32, 1
    torch.manual_seed(0)
    processors = make_diffusion_transformer_pre_post_processors(config, STATS)
    return save(DiffusionTransformerPolicy(config), processors, tmp_path_factory.mktemp("teacher"))


def make_student(path: Path, teacher: Path, representation: str = "action") -> Path:
    config = AGPDConfig(
        input_features=INPUTS,
        output_features=OUTPUTS,
        device="cpu",
        push_to_hub=False,
        chunk_size=8,
        n_action_steps=N_STEPS,
        dim_model=32,
        n_heads=2,
        dim_feedforward=32,
        n_encoder_layers=1,
        n_vae_encoder_layers=1,
        latent_dim=4,
    )
    config.teacher.path = str(teacher)
    config.guidance.scale = 2.0
    config.representation.type = representation
    torch.manual_seed(1)
    return save(AGPDPolicy(config), make_agpd_pre_post_processors(config, STATS), path)


@pytest.fixture
def student(tmp_path, teacher) -> Path:
    return make_student(tmp_path / "run/checkpoints/000010/pretrained_model", teacher)


def call(monkeypatch, *options: str) -> None:
    arguments = ["--env.type=pusht", "--env.obs_type=environment_state_agent_pos"]
    arguments += [f"--env.episode_length={EPISODE_LENGTH}", "--env.visualization_width=96"]
    monkeypatch.setattr(sys, "argv", ["lerobot-agpd-viz", *arguments, *options])
    viz.main()


def make_config(monkeypatch, student: Path, **options) -> viz.VizConfig:
    monkeypatch.setattr(sys, "argv", ["lerobot-agpd-viz", f"--policy.path={student}"])
    env = PushtEnv(obs_type="environment_state_agent_pos", episode_length=EPISODE_LENGTH)
    return viz.VizConfig(env=env, **options)


def rollouts(config: viz.VizConfig, scale: float) -> list:
    return list(viz.record_rollouts(config, viz.make_guided_teacher(config), scale))


def test_command_writes_recording_and_picture(monkeypatch, student, tmp_path):
    output, png = tmp_path / "new/a.rrd", tmp_path / "other/a.png"
    call(monkeypatch, f"--policy.path={student}", "--episodes=2", f"--output={output}", f"--png={png}")
    assert png.read_bytes().startswith(b"\x89PNG")
    entities = {chunk.entity_path for chunk in RrdReader(output).store().stream()}
    for episode in range(2):
        root = f"/episode_{episode}"
        wanted = {f"{root}/{name}" for name in ("J", "shift", "action", "reward", "success", "frame")}
        wanted |= {f"{root}/observation/{name}" for name in ("state", "environment_state")}
        for name in ("teacher", "guided", "student"):
            wanted |= {f"{root}/frame/{name}", f"{root}/chunk/0/{name}", f"{root}/chunk/1/{name}"}
        assert wanted <= entities


def test_decisions_and_frames_belong_to_the_steps(monkeypatch, student):
    config = make_config(monkeypatch, student, episodes=2, seed=100_003)
    for number, (episode, rollout) in enumerate(rollouts(config, scale=2.0)):
        assert episode.ticket.seed == 100_003 + number
        assert len(rollout.frames) == len(episode) == EPISODE_LENGTH
        assert [decision.step for decision in rollout.decisions] == [0, 4, 8]
        executed = np.concatenate([decision.chunks.guided for decision in rollout.decisions])
        np.testing.assert_array_equal(executed[:EPISODE_LENGTH], episode.actions)
        # The frame shows the agent (royal blue) where the observation of the same step says it is.
        for step in (0, 5, 9):
            x, y = rollout.to_frame(episode.observations[OBS_STATE][step][None])[0].astype(int)
            assert rollout.frames[step][y, x, 2] > 150 and rollout.frames[step][y, x, 0] < 120


@pytest.mark.parametrize("representation", ["action", "state"])
def test_guidance_pulls_toward_the_student_from_the_same_noise(
    monkeypatch, tmp_path, teacher, representation
):
    student = make_student(tmp_path / "student", teacher, representation)
    config = make_config(monkeypatch, student, render=False)
    ((_, unguided),) = rollouts(config, scale=0.0)
    ((_, guided),) = rollouts(config, scale=50.0)
    assert not guided.frames
    for decision in unguided.decisions:
        np.testing.assert_array_equal(decision.chunks.guided, decision.chunks.teacher)
    first = guided.decisions[0]
    np.testing.assert_array_equal(first.chunks.teacher, unguided.decisions[0].chunks.teacher)
    np.testing.assert_array_equal(first.chunks.student, unguided.decisions[0].chunks.student)
    assert np.abs(first.chunks.guided - first.chunks.teacher).max() > 0
    assert np.isfinite(first.shift_in_sigmas)
    if representation == "action":
        assert all(decision.j_guided < decision.j_teacher for decision in guided.decisions)


def test_student_chunk_is_what_the_policy_executes(monkeypatch, student):
    config = make_config(monkeypatch, student, render=False)
    ((episode, rollout),) = rollouts(config, scale=0.0)
    loaded = load_student(config.policy)
    preprocessor, postprocessor = make_pre_post_processors(config.policy, pretrained_path=str(student))
    observation = {key: torch.from_numpy(episode.observations[key][0]) for key in INPUTS}
    chunk = loaded.student.predict_action_chunk(preprocessor(observation))[:, :N_STEPS]
    np.testing.assert_allclose(rollout.decisions[0].chunks.student, postprocessor(chunk)[0], rtol=1e-5)


def test_scale_is_given_or_the_runs_or_the_policys(monkeypatch, student, tmp_path):
    assert viz.guidance_scale(make_config(monkeypatch, student, scale=0.25)) == 0.25
    assert viz.guidance_scale(make_config(monkeypatch, student)) == 2.0
    (student / "agpd_state.json").write_text(json.dumps({"updates": 10, "rounds": 2}))
    assert viz.guidance_scale(make_config(monkeypatch, student)) == 2.0  # the rounds are gone
    for number, scale in enumerate((3.0, 6.0, 12.0)):  # the last one is newer than the checkpoint
        folder = tmp_path / f"run/agpd/round-{number:03d}"
        folder.mkdir(parents=True)
        (folder / "round.json").write_text(json.dumps({"next_scale": scale}))
    assert viz.guidance_scale(make_config(monkeypatch, student)) == 6.0


def test_teacher_flags_override_the_checkpoints(monkeypatch, student, teacher):
    config = make_config(monkeypatch, student, teacher=TeacherConfig(num_inference_steps=3))
    guided = viz.make_guided_teacher(config)
    assert guided.pair.teacher.policy.diffusion.num_inference_steps == 3
    config = make_config(monkeypatch, student, teacher=TeacherConfig(path="nowhere/to/be/found"))
    with pytest.raises(FileNotFoundError, match="nowhere/to/be/found"):
        viz.make_guided_teacher(config)


def test_failing_renderer_names_the_remedies(monkeypatch, student):
    from gym_pusht.envs.pusht import PushTEnv

    def no_gl(self):
        raise RuntimeError("gladLoadGL error")

    monkeypatch.setattr(PushTEnv, "render", no_gl)
    config = make_config(monkeypatch, student)
    with pytest.raises(RuntimeError, match=r"gladLoadGL error.*MUJOCO_GL.*--render=false"):
        rollouts(config, scale=1.0)
    assert rollouts(make_config(monkeypatch, student, render=False), scale=1.0)


def test_wrong_options_are_refused(monkeypatch, student, teacher):
    with pytest.raises(ValueError, match="--episodes"):
        make_config(monkeypatch, student, episodes=0)
    with pytest.raises(ValueError, match="--scale"):
        make_config(monkeypatch, student, scale=-1.0)
    with pytest.raises(ValueError, match="has no teacher"):
        make_config(monkeypatch, teacher)
    monkeypatch.setattr(sys, "argv", ["lerobot-agpd-viz"])
    with pytest.raises(ValueError, match=r"--policy\.path is not set"):
        viz.VizConfig(env=PushtEnv())
