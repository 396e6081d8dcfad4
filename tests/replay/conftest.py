"""Recorded episodes and journals."""

import numpy as np
import pytest
import torch

from lerobot_agpd.replay.demonstrations import DemonstrationFrames
from lerobot_agpd.replay.episode import Episode, EpisodeRecord, EpisodeSpec
from lerobot_agpd.replay.journal import EpisodeJournal
from lerobot_agpd.replay.replay import Replay

IDENTITY = {"strategy": "guided", "environment": {"type": "a", "task": "b"}, "teacher": "t", "seed": 1}


@pytest.fixture(scope="session")
def make_episode():
    """Builds rollouts of random numbers, known by their number; `observation.state` is (100 + number, step)."""

    def build(number, length=3, strength=0.5, success=True, **options) -> Episode:
        rng = np.random.default_rng(number)
        state = np.stack([np.full(length, 100 + number), np.arange(length)], axis=1).astype(np.float32)
        vectors = {
            "observation.state": state,
            "observation.environment_state": rng.normal(size=(length, 3)).astype(np.float32),
        }
        return Episode(
            **{
                "spec": EpisodeSpec(number, 1_000_000 + number, strength),
                "task": f"task {number}",
                "observations": vectors,
                "actions": rng.normal(size=(length, 2)).astype(np.float32),
                "rewards": rng.normal(size=length).astype(np.float32),
                "successes": np.arange(length) == length - 1 if success else np.zeros(length, dtype=bool),
                "discrepancy": 0.25 if strength else float("nan"),
                **options,
            }
        )

    return build


@pytest.fixture(scope="session")
def make_record():
    """Builds the record of an episode that is kept if it ends in success."""

    def build(episode: Episode) -> EpisodeRecord:
        return EpisodeRecord(
            number=episode.spec.number,
            seed=episode.spec.seed,
            strength=episode.spec.strength,
            length=len(episode),
            max_reward=episode.max_reward,
            is_success=episode.is_success,
            success=bool(episode.is_success),
            solved_at_start=False,
            kept=bool(episode.is_success),
            discrepancy=episode.discrepancy,
            guidance_shift=episode.guidance_shift,
            student_steps=episode.student_steps,
        )

    return build


@pytest.fixture
def journal(tmp_path, demonstrations) -> EpisodeJournal:
    journal = EpisodeJournal(tmp_path / "run" / "agpd")
    journal.begin(demonstrations.meta, IDENTITY)
    return journal


@pytest.fixture
def add(make_record):
    """Appends episodes to a journal."""

    def append(journal, round_number, rank, *episodes):
        for episode in episodes:
            journal.append(round_number, rank, episode, make_record(episode))

    return append


@pytest.fixture
def stored(journal, add, make_episode):
    """Kept episodes of these lengths, as the journal delivers them."""

    def build(*lengths):
        add(journal, 0, 0, *(make_episode(number, length) for number, length in enumerate(lengths)))
        return journal.kept(0)

    return build


@pytest.fixture
def small_replay(demonstrations, agpd_config) -> Replay:
    """The demonstrations for chunks of 4 steps; the loader has delivered the first of them."""
    config = agpd_config(chunk_size=4, n_action_steps=2)
    frames = DemonstrationFrames(config, demonstrations.meta, demonstrations.meta.stats)
    replay = Replay(frames, config, None)
    columns = {key: frames.table.columns[key][:3] for key in frames.keys}
    replay.observe({**columns, "index": torch.arange(3), "episode_index": torch.zeros(3, dtype=torch.long)})
    return replay
