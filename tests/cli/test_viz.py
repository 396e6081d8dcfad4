"""`lerobot-agpd-viz`, end to end on Push-T with random policies."""

import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.vector import VectorEnv
from lerobot.envs.configs import PushtEnv
from lerobot.policies import make_pre_post_processors
from lerobot.utils.constants import OBS_ENV_STATE, OBS_STATE
from PIL import Image

from lerobot_agpd.cli import viz
from lerobot_agpd.config import TeacherConfig
from lerobot_agpd.files import write_json
from lerobot_agpd.flag_checks import FlagError
from lerobot_agpd.loading import load_student
from lerobot_agpd.progress import Progress
from lerobot_agpd.rollout.report import RoundReport
from lerobot_agpd.studies.recording import plane_to_frame

pytest.importorskip("gym_pusht")
RrdReader = pytest.importorskip("rerun.experimental").RrdReader

N_STEPS, EPISODE_LENGTH = 4, 10


def call(monkeypatch, *options: str) -> None:
    arguments = ["--env.type=pusht", "--env.obs_type=environment_state_agent_pos"]
    arguments += [f"--env.episode_length={EPISODE_LENGTH}", "--env.visualization_width=96"]
    arguments += ["--env.visualization_height=96"]
    monkeypatch.setattr(sys, "argv", ["lerobot-agpd-viz", *arguments, *options])
    viz.main()


def make_config(monkeypatch, student: Path, **options) -> viz.VizConfig:
    monkeypatch.setattr(sys, "argv", ["lerobot-agpd-viz", f"--policy.path={student}"])
    env = PushtEnv(obs_type="environment_state_agent_pos", episode_length=EPISODE_LENGTH)
    return viz.VizConfig(env=env, **options)


def rollouts(config: viz.VizConfig, scale: float) -> list:
    return list(viz.record_rollouts(config, viz.make_guided_strategy(config), scale))


def test_command_writes_recording_and_picture(monkeypatch, student, tmp_path):
    output, png = tmp_path / "new/a.rrd", tmp_path / "other/a.png"
    film = tmp_path / "film.gif"
    flags = [f"--output={output}", f"--png={png}", f"--animation={film}", "--panel_width=96"]
    call(monkeypatch, f"--policy.path={student}", "--episodes=2", *flags)
    assert png.read_bytes().startswith(b"\x89PNG") and film.read_bytes().startswith(b"GIF")
    entities = {chunk.entity_path for chunk in RrdReader(output).store().stream()}
    for episode in range(2):
        root = f"/episode_{episode}"
        wanted = {
            f"{root}/{name}"
            for name in ("discrepancy", "guidance_shift", "action", "reward", "success", "frame")
        }
        wanted |= {f"{root}/observation/{name}" for name in ("state", "environment_state")}
        for name in ("teacher", "guided", "student"):
            wanted |= {f"{root}/frame/{name}", f"{root}/chunk/0/{name}", f"{root}/chunk/1/{name}"}
        assert wanted <= entities


def test_policies_side_by_side(monkeypatch, student, teacher, tmp_path):
    """Without a guided teacher: no recording, both from the same start."""
    film = tmp_path / "film.gif"
    call(
        monkeypatch,
        f"--policies={{teacher: {teacher}, student: {student}}}",
        f"--animation={film}",
        "--panel_width=96",
        "--stride=5",
    )
    with Image.open(film) as opened:
        first = np.asarray(opened.convert("RGB"))
        assert first.shape[1] == 2 * 96 and opened.n_frames > 1
    panels = [first[-96:, :96], first[-96:, 96:]]
    gray = [np.abs(panel.astype(int) - (119, 136, 153)).max(axis=-1) < 30 for panel in panels]  # the block
    assert gray[0].any() and (gray[0] == gray[1]).mean() > 0.97


def test_only_positions_are_drawn_on_the_frame():
    agent = gym.spaces.Box(0, 512, (2,))
    for space, observed, drawn in (
        (gym.spaces.Box(0, 512, (2,)), {"agent_pos": agent}, True),
        (gym.spaces.Box(-1, 1, (2,)), {"agent_pos": agent}, False),  # a force
        (gym.spaces.Box(0, 512, (2,)), {"pixels": agent}, False),
        (gym.spaces.Box(0, 512, (3,)), {"agent_pos": agent}, False),
    ):
        env = VectorEnv()
        env.single_action_space, env.single_observation_space = space, gym.spaces.Dict(observed)
        to_frame = plane_to_frame(env, np.zeros((256, 128, 3)))
        assert (to_frame is not None) == drawn
        if to_frame is not None:
            np.testing.assert_array_equal(to_frame(np.array([[512.0, 256.0]])), [[128.0, 128.0]])


def test_decisions_and_frames_belong_to_the_steps(monkeypatch, student):
    config = make_config(monkeypatch, student, episodes=2, seed=100_003)
    for number, rollout in enumerate(rollouts(config, scale=2.0)):
        episode = rollout.episode
        assert episode.spec.seed == 100_003 + number
        assert len(rollout.frames) == len(episode) == EPISODE_LENGTH
        assert [decision.step for decision in rollout.decisions] == [0, 4, 8]
        executed = np.concatenate([decision.chunks["guided"] for decision in rollout.decisions])
        np.testing.assert_array_equal(executed[:EPISODE_LENGTH], episode.actions)
        # The frame shows the agent (royal blue) where the observation of the same step says it is.
        for step in (0, 5, 9):
            x, y = rollout.to_frame(episode.observations[OBS_STATE][step][None])[0].astype(int)
            assert rollout.frames[step][y, x, 2] > 150 and rollout.frames[step][y, x, 0] < 120


@pytest.mark.parametrize("representation", ["action", "state"])
def test_guidance_pulls_toward_the_student_from_the_same_noise(
    monkeypatch, tmp_path, teacher, representation, student_of
):
    student = student_of(tmp_path / "student", teacher, representation)
    config = make_config(monkeypatch, student, render=False)
    (unguided,) = rollouts(config, scale=0.0)
    (guided,) = rollouts(config, scale=50.0)
    assert not guided.frames
    for decision in unguided.decisions:
        np.testing.assert_array_equal(decision.chunks["guided"], decision.chunks["teacher"])
    first = guided.decisions[0]
    np.testing.assert_array_equal(first.chunks["teacher"], unguided.decisions[0].chunks["teacher"])
    np.testing.assert_array_equal(first.chunks["student"], unguided.decisions[0].chunks["student"])
    assert np.abs(first.chunks["guided"] - first.chunks["teacher"]).max() > 0
    assert np.isfinite(first.guidance_shift)
    if representation == "action":
        assert all(
            decision.guided_discrepancy < decision.teacher_discrepancy for decision in guided.decisions
        )


def test_student_chunk_is_what_the_policy_executes(monkeypatch, student):
    config = make_config(monkeypatch, student, render=False)
    (rollout,) = rollouts(config, scale=0.0)
    loaded = load_student(config.policy)
    preprocessor, postprocessor = make_pre_post_processors(config.policy, pretrained_path=str(student))
    observation = {
        key: torch.from_numpy(rollout.episode.observations[key][0]) for key in (OBS_STATE, OBS_ENV_STATE)
    }
    chunk = loaded.student.predict_action_chunk(preprocessor(observation))[:, :N_STEPS]
    np.testing.assert_allclose(rollout.decisions[0].chunks["student"], postprocessor(chunk)[0], rtol=1e-5)


def test_scale_is_given_or_the_runs_or_the_policys(monkeypatch, student, tmp_path):
    assert viz.guidance_strength(make_config(monkeypatch, student, strength=0.25), None) == 0.25
    assert viz.guidance_strength(make_config(monkeypatch, student), None) == 2.0
    Progress(step=10, rounds=2).save(student)
    assert viz.guidance_strength(make_config(monkeypatch, student), None) == 2.0  # the rounds are gone
    for number, scale in enumerate((3.0, 6.0, 12.0)):  # the last one is newer than the checkpoint
        folder = tmp_path / f"run/agpd/round-{number:05d}"
        folder.mkdir(parents=True)
        facts = {"round": number, "strength": 1.0, "next_strength": scale, "step": 10}
        write_json(folder / "report.json", RoundReport.of([], **facts).to_json())
    assert viz.guidance_strength(make_config(monkeypatch, student), None) == 6.0


def test_teacher_flags_override_the_checkpoints(monkeypatch, student, teacher):
    config = make_config(monkeypatch, student, teacher=TeacherConfig(num_inference_steps=3))
    guided = viz.make_guided_strategy(config)
    assert guided.pair.teacher.policy.diffusion.num_inference_steps == 3
    config = make_config(monkeypatch, student, teacher=TeacherConfig(path="nowhere/to/be/found"))
    with pytest.raises(FileNotFoundError, match="nowhere/to/be/found"):
        viz.make_guided_strategy(config)


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
    with pytest.raises(FlagError, match="--episodes"):
        make_config(monkeypatch, student, episodes=0)
    for options, flag in (
        ({"policies": {"teacher": teacher}}, "--animation"),
        ({"animation": Path("a.gif"), "render": False}, "--render=false"),
        ({"animation": Path("a.gif"), "stride": 0}, "--stride"),
    ):
        with pytest.raises(FlagError, match=flag):
            make_config(monkeypatch, student, **options)
    with pytest.raises(FlagError, match="--strength"):
        make_config(monkeypatch, student, strength=-1.0)
    with pytest.raises(FlagError, match="has no teacher"):
        make_config(monkeypatch, teacher)
    monkeypatch.setattr(sys, "argv", ["lerobot-agpd-viz"])
    with pytest.raises(FlagError, match=r"--policy\.path is not set"):
        viz.VizConfig(env=PushtEnv())
