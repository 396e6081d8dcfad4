"""T during training: which rows a step sees."""

import numpy as np
import pytest
import torch

from lerobot_agpd.replay.episode import Episode, Ticket
from lerobot_agpd.replay.memory import FrameMemory
from lerobot_agpd.replay.normalisation import Normaliser, floor_statistics
from lerobot_agpd.replay.replay import ROW, Replay
from lerobot_agpd.replay.writer import EpisodeWriter

KEYS = ["action", "observation.state", "observation.environment_state"]
N_DEMONSTRATED = 13  # 5 + 1 + 7
COLLECTED = (4, 3)


def rollout(number, length) -> Episode:
    """An episode whose first state entry is 100 + number."""
    rng = np.random.default_rng(number)
    state = np.stack([np.full(length, 100 + number), np.arange(length)], axis=1)
    return Episode(
        Ticket(number, 1_000_000, 1.0),
        "a small task",
        {
            "observation.state": state.astype(np.float32),
            "observation.environment_state": rng.normal(size=(length, 3)).astype(np.float32),
        },
        rng.normal(size=(length, 2)).astype(np.float32),
        np.zeros(length, dtype=np.float32),
        np.ones(length, dtype=bool),
        0.0,
        0.0,
    )


@pytest.fixture(scope="module")
def collected(demonstrations, tmp_path_factory):
    """Datasets of two rounds, of one episode each."""
    roots = []
    for number, length in enumerate(COLLECTED):
        root = tmp_path_factory.mktemp("rounds") / f"round-{number:03d}" / "rank-0"
        EpisodeWriter(demonstrations.meta).write(root, [rollout(number, length)], number, "guided")
        roots.append(root)
    return roots


@pytest.fixture
def normaliser(demonstrations, agpd_config) -> Normaliser:
    return Normaliser(agpd_config(), floor_statistics(demonstrations.meta.stats))


@pytest.fixture
def deliver(demonstrations, normaliser):
    """A batch as LeRobot's loader and preprocessor deliver it."""

    def batch(rows):
        frames = [demonstrations[row] for row in rows]
        stacked = {key: normaliser.normalise(key, torch.stack([f[key] for f in frames])) for key in KEYS}
        extra = {key: torch.stack([f[key] for f in frames]) for key in ("index", "episode_index")}
        return {**stacked, **extra}

    return batch


@pytest.fixture
def make_replay(demonstrations, agpd_config):
    def build(share=None) -> Replay:
        config = agpd_config(chunk_size=4, n_action_steps=2)
        return Replay(FrameMemory(config, demonstrations.meta, demonstrations.meta.stats), config, share)

    return build


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def test_share_is_uniform_over_what_was_seen(make_replay, deliver, collected):
    replay = make_replay()
    replay.observe(deliver([0, 6]))  # episodes 0 and 2: 5 + 7 frames
    assert replay.share() == 0.0
    replay.add_dataset(collected[0])
    assert replay.share() == pytest.approx(4 / (12 + 4))
    replay.add_dataset(collected[1])
    assert replay.share() == pytest.approx(7 / (12 + 7))
    replay.observe(deliver([5]))
    assert replay.seen_episodes == {0, 1, 2} and replay.share() == pytest.approx(7 / (13 + 7))


def test_collected_share_overrides(make_replay, deliver, collected):
    replay = make_replay(share=0.25)
    replay.observe(deliver([0]))
    assert replay.share() == 0.0  # nothing to fill it with
    replay.add_dataset(collected[0])
    assert replay.share() == 0.25


def test_without_collected_frames_rows_are_the_loaders(make_replay, deliver, demonstrations, normaliser):
    replay = make_replay(share=0.9)
    order = [11, 0, 5, 4, 4]
    batch = deliver(order)
    replay.observe(batch)
    rows = replay.training_rows(batch, generator())
    assert rows[ROW].tolist() == order
    for position, row in enumerate(order):
        frame = demonstrations[row]
        for key in KEYS[1:]:
            expected = normaliser.normalise(key, frame[key])
            torch.testing.assert_close(rows[key][position], expected, rtol=0, atol=1e-6)
            assert torch.equal(rows[key][position], batch[key][position])
        last = int(demonstrations.meta.episodes["dataset_to_index"][int(frame["episode_index"])]) - 1
        steps = [min(row + k, last) for k in range(4)]
        chunk = torch.stack([normaliser.normalise("action", demonstrations[s]["action"]) for s in steps])
        torch.testing.assert_close(rows["action"][position], chunk, rtol=0, atol=1e-6)
        assert rows["action_is_pad"][position].tolist() == [row + k > last for k in range(4)]


def test_exchanged_rows_are_collected_frames_and_the_rest_the_loaders(
    make_replay, deliver, collected, normaliser
):
    replay = make_replay(share=0.5)
    for root in collected:
        replay.add_dataset(root)
    batch = deliver([0, 1, 2, 3, 4] * 40)  # the loader knows episode 0 alone
    replay.observe(batch)
    rows = replay.training_rows(batch, generator())
    exchanged = rows[ROW] >= N_DEMONSTRATED
    assert torch.equal(rows[ROW][~exchanged], batch["index"][~exchanged])
    assert 0.35 < exchanged.float().mean() < 0.65
    assert set(rows[ROW][exchanged].tolist()) == set(range(N_DEMONSTRATED, N_DEMONSTRATED + 7))
    assert not set(range(5, N_DEMONSTRATED)) & set(rows[ROW].tolist())  # episodes that were left out
    raw = normaliser.unnormalise("observation.state", rows["observation.state"])
    episodes = raw[:, 0].round()
    assert set(episodes[exchanged].tolist()) == {100.0, 101.0} and (episodes[~exchanged] == 0).all()
    sources = [rollout(number, length) for number, length in enumerate(COLLECTED)]
    for row, state, chunk, is_pad in zip(
        rows[ROW].tolist(),
        raw,
        normaliser.unnormalise("action", rows["action"]),
        rows["action_is_pad"],
        strict=True,
    ):
        if row < N_DEMONSTRATED:
            continue
        source, step = sources[int(state[0].round()) - 100], int(state[1].round())
        assert row == N_DEMONSTRATED + step + (COLLECTED[0] if state[0] > 100.5 else 0)
        steps = [min(step + k, len(source) - 1) for k in range(4)]
        torch.testing.assert_close(chunk, torch.from_numpy(source.actions[steps]), rtol=0, atol=1e-4)
        assert is_pad.tolist() == [step + k >= len(source) for k in range(4)]


def test_a_diffusion_student_draws_no_dropped_frame(
    demonstrations, agpd_config, agpd_diffusion_config, deliver, collected
):
    """With the last 3 dropped, the episode of 4 frames begins one chunk, that of 3 none."""
    config = agpd_diffusion_config(normalization_mapping=agpd_config().normalization_mapping)
    assert config.drop_n_last_frames == 3
    memory = FrameMemory(config, demonstrations.meta, demonstrations.meta.stats)
    uniform, fixed = (Replay(memory, config, share) for share in (None, 0.5))
    batch = deliver([0, 1, 5, 6] * 20)
    for replay in (uniform, fixed):
        replay.observe(batch)
        replay.add_dataset(collected[1])
        assert replay.share() == 0.0, "nothing to fill it with"
        replay.add_dataset(collected[0])
        rows = replay.training_rows(batch, generator())[ROW]
        assert set(rows[rows >= N_DEMONSTRATED].tolist()) == {N_DEMONSTRATED + COLLECTED[1]}
    assert fixed.share() == 0.5
    assert uniform.share() == pytest.approx(1 / ((5 - 3) + 0 + (7 - 3) + 1))


def test_rows_depend_on_the_generator_alone(make_replay, deliver, collected):
    replay = make_replay(share=0.5)
    replay.add_dataset(collected[0])
    batch = deliver(list(range(13)))
    replay.observe(batch)
    torch.manual_seed(1)
    first = replay.training_rows(batch, generator(3))[ROW]
    torch.manual_seed(2)
    assert torch.equal(replay.training_rows(batch, generator(3))[ROW], first)
    assert not torch.equal(replay.training_rows(batch, generator(4))[ROW], first)
    assert batch["index"].tolist() == list(range(13))  # the loader's batch is left alone


def test_held_out_rows_are_demonstrations(make_replay, deliver, collected):
    replay = make_replay(share=0.9)
    replay.add_dataset(collected[0])
    batch = deliver([1, 2])
    replay.memory.observe(batch)
    assert replay.demonstration_rows(batch)[ROW].tolist() == [1, 2]
    assert replay.seen_episodes == set()


def test_history_is_raw_and_stays_in_its_episode(make_replay, deliver, collected, demonstrations):
    replay = make_replay()
    replay.add_dataset(collected[0])
    replay.observe(deliver([0]))
    history = replay.history(torch.tensor([0, 5, 7, 13, 15]), ["observation.state"], 2)["observation.state"]
    assert history.tolist() == [
        [[0, 0], [0, 0]],
        [[1, 0], [1, 0]],
        [[2, 0], [2, 1]],
        [[100, 0], [100, 0]],
        [[100, 1], [100, 2]],
    ]


def test_executed_future_and_its_mask(make_replay, deliver, collected, normaliser):
    replay = make_replay()
    replay.add_dataset(collected[0])
    replay.observe(deliver([0]))
    rows = torch.tensor([0, 3, 5, 13, 14])
    now, executed, later, is_pad = replay.executed_future(rows, ["observation.state"], 3)
    recorded = replay.table.columns["action"]
    assert torch.equal(executed[0], recorded[0:3]) and torch.equal(executed[3], recorded[13:16])
    steps = [normaliser.unnormalise("observation.state", x)[:, 1].round().tolist() for x in (now, later)]
    assert steps == [[0, 3, 0, 0, 1], [3, 4, 0, 3, 3]]
    assert is_pad.tolist() == [False, True, True, False, True]


def test_a_batch_under_other_statistics_is_refused(make_replay, deliver):
    batch = deliver([0, 1, 7])
    batch["action"] = batch["action"] * 1.1
    with pytest.raises(ValueError, match="no known statistics"):
        make_replay().observe(batch)
