"""Rerun recordings and stills of synthetic rollouts."""

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
import rerun as rr
from gymnasium.vector import SyncVectorEnv

from lerobot_agpd.replay.episode import Episode, EpisodeSpec
from lerobot_agpd.studies.recording import COLORS, DecisionRecord, RolloutRecord, action_names
from lerobot_agpd.studies.rerun_log import TIMELINE, blueprint, layout, log_rollout
from lerobot_agpd.studies.still import draw_still

RrdReader = pytest.importorskip("rerun.experimental").RrdReader

N_STEPS, CHUNK = 10, 4


def make_rollout(action_dim: int = 2, frames: bool = True, overlay: bool = True) -> RolloutRecord:
    """A rollout of random numbers; its last chunk ends after the episode does."""
    rng = np.random.default_rng(0)

    def decision(step: int) -> DecisionRecord:
        chunks = rng.uniform(0, 100, size=(3, CHUNK, action_dim)).astype(np.float32)
        return DecisionRecord(
            step, dict(zip(COLORS, chunks, strict=True)), 2.0 + step, 1.0 + step, float("nan")
        )

    episode = Episode(
        spec=EpisodeSpec(0, 0, 1.0),
        task="",
        observations={
            "observation.state": rng.normal(size=(N_STEPS, 5)).astype(np.float32),
            "observation.images.top": rng.integers(0, 255, (N_STEPS, 16, 16, 3), dtype=np.uint8),
        },
        actions=rng.uniform(0, 100, size=(N_STEPS, action_dim)).astype(np.float32),
        rewards=np.linspace(0, 1, N_STEPS, dtype=np.float32),
        successes=np.arange(N_STEPS) >= 8,
    )
    return RolloutRecord(
        episode=episode,
        decisions=[decision(step) for step in range(0, N_STEPS, CHUNK)],
        frames=list(rng.integers(0, 255, (N_STEPS, 32, 24, 3), dtype=np.uint8)) if frames else [],
        to_frame=(lambda actions: 2 * actions) if overlay else None,
    )


def write(rollout: RolloutRecord, path) -> dict[str, dict[str, list]]:
    """Record the rollout and read it back: entity path to component (and timeline) to values."""
    with rr.RecordingStream("test") as stream:
        stream.save(path)
        log_rollout(stream, "episode_0", rollout)
        stream.send_blueprint(blueprint([layout("episode_0", rollout)]))
    entities: dict[str, dict[str, list]] = {}
    for chunk in RrdReader(path).store().stream():
        entity = entities.setdefault(chunk.entity_path.removeprefix("/"), {})
        for name, values in chunk.to_record_batch().to_pydict().items():
            entity.setdefault(name, []).extend(values)
    return entities


def series(entity: dict[str, list]) -> tuple[list[int], np.ndarray]:
    return entity[TIMELINE], np.array(entity["Scalars:scalars"])


def test_recording_holds_what_happened(tmp_path):
    rollout = make_rollout()
    entities = write(rollout, tmp_path / "a.rrd")
    for name, values in (
        ("action", rollout.episode.actions),
        ("observation/state", rollout.episode.observations["observation.state"]),
        ("reward", rollout.episode.rewards[:, None]),
        ("success", rollout.episode.successes[:, None]),
    ):
        steps, logged = series(entities[f"episode_0/{name}"])
        assert steps == list(range(N_STEPS))
        np.testing.assert_array_equal(logged, values)
    for name in ("frame", "observation/images/top"):
        assert len(entities[f"episode_0/{name}"]["EncodedImage:blob"]) == N_STEPS
        assert entities[f"episode_0/{name}"]["EncodedImage:media_type"][0] == ["image/jpeg"]


def test_recording_holds_what_was_planned(tmp_path):
    rollout = make_rollout()
    entities = write(rollout, tmp_path / "a.rrd")
    for name in ("teacher", "guided", "student"):
        chunks = np.concatenate([d.chunks[name] for d in rollout.decisions])
        for dim in range(2):
            steps, logged = series(entities[f"episode_0/chunk/{dim}/{name}"])
            assert steps == list(range(3 * CHUNK))  # beyond the end of the episode
            np.testing.assert_array_equal(logged[:, 0], chunks[:, dim])
        strips = entities[f"episode_0/frame/{name}"]
        assert [step for step in strips[TIMELINE] if step is not None] == [0, 4, 8]
        drawn = np.array([row[0] for row in strips["LineStrips2D:strips"]])
        np.testing.assert_allclose(drawn.reshape(-1, 2), 2 * chunks)
    points = np.array([row[0] for row in entities["episode_0/frame/executed"]["Points2D:positions"]])
    np.testing.assert_allclose(points, 2 * rollout.episode.actions)
    steps, discrepancy = series(entities["episode_0/discrepancy"])
    assert steps == [0, 4, 8]
    np.testing.assert_array_equal(discrepancy, [[2, 1], [6, 5], [10, 9]])
    assert np.isnan(series(entities["episode_0/guidance_shift"])[1]).all()


def test_recording_comes_with_its_views(tmp_path):
    write(make_rollout(), tmp_path / "a.rrd")
    assert len(RrdReader(tmp_path / "a.rrd").blueprints()) == 1


def test_neither_frames_nor_overlay_nor_success(tmp_path):
    rollout = make_rollout(action_dim=4, frames=False, overlay=False)
    rollout.episode.successes = None
    entities = write(rollout, tmp_path / "a.rrd")
    assert not [path for path in entities if path.startswith("episode_0/frame")]
    assert "episode_0/success" not in entities and "episode_0/chunk/3/student" in entities


@pytest.mark.parametrize(("action_dim", "frames"), [(2, True), (1, True), (5, False)])
def test_still_is_drawn(tmp_path, action_dim, frames):
    path = tmp_path / "still.png"
    draw_still(make_rollout(action_dim, frames, overlay=action_dim == 2), path)
    assert path.read_bytes().startswith(b"\x89PNG")


def test_still_of_a_single_decision(tmp_path):
    rollout = make_rollout()
    draw_still(replace(rollout, decisions=rollout.decisions[:1]), tmp_path / "still.png")
    assert (tmp_path / "still.png").stat().st_size > 0


def test_actions_have_the_environments_names():
    rollout = replace(make_rollout(), action_names=("left", "right"))
    assert [rollout.name_of(dim) for dim in range(2)] == ["left", "right"]
    assert make_rollout().name_of(1) == "action 1"
    named = SyncVectorEnv([NamedActions])
    assert action_names(named) == ["force x", "force y"]
    named.envs[0].action_names = ("one",)  # of another action
    assert action_names(named) == ["action 0", "action 1"]


class NamedActions(gym.Env):
    """Says what its actions are."""

    observation_space, action_space = gym.spaces.Box(0, 1, (1,)), gym.spaces.Box(0, 1, (2,))
    action_names = ("force x", "force y")
