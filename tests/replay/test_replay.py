"""T during training: which frames a step sees."""

import pytest
import torch

from lerobot_agpd.replay.demonstrations import DemonstrationFrames
from lerobot_agpd.replay.journal import EpisodeJournal
from lerobot_agpd.replay.normalization import Normalizer, floor_statistics
from lerobot_agpd.replay.replay import FRAME_INDEX, Replay

KEYS = ["action", "observation.state", "observation.environment_state"]
N_DEMONSTRATED = 13  # 5 + 1 + 7
COLLECTED = (4, 3)


@pytest.fixture
def collected(stored):
    """Two kept episodes."""
    return stored(*COLLECTED)


@pytest.fixture
def normalizer(demonstrations, agpd_config) -> Normalizer:
    return Normalizer(agpd_config(), floor_statistics(demonstrations.meta.stats))


@pytest.fixture
def deliver(demonstrations, normalizer):
    """A batch as LeRobot's loader and preprocessor deliver it."""

    def batch(rows):
        frames = [demonstrations[row] for row in rows]
        stacked = {key: normalizer.normalize(key, torch.stack([f[key] for f in frames])) for key in KEYS}
        extra = {key: torch.stack([f[key] for f in frames]) for key in ("index", "episode_index")}
        return {**stacked, **extra}

    return batch


@pytest.fixture
def make_replay(demonstrations, agpd_config):
    def build(fraction=None) -> Replay:
        config = agpd_config(chunk_size=4, n_action_steps=2)
        return Replay(
            DemonstrationFrames(config, demonstrations.meta, demonstrations.meta.stats), config, fraction
        )

    return build


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def test_fraction_is_uniform_over_what_was_seen(make_replay, deliver, collected):
    replay = make_replay()
    replay.observe(deliver([0, 6]))  # episodes 0 and 2: 5 + 7 frames
    assert replay.collected_fraction == 0.0
    replay.extend([collected[0]])
    assert replay.collected_fraction == pytest.approx(4 / (12 + 4))
    replay.extend([collected[1]])
    assert replay.collected_fraction == pytest.approx(7 / (12 + 7))
    replay.observe(deliver([5]))
    assert replay.seen_episodes == {0, 1, 2} and replay.collected_fraction == pytest.approx(7 / (13 + 7))


def test_a_given_fraction_overrides(make_replay, deliver, collected):
    replay = make_replay(fraction=0.25)
    replay.observe(deliver([0]))
    assert replay.collected_fraction == 0.0  # nothing to fill it with
    replay.extend([collected[0]])
    assert replay.collected_fraction == 0.25


def test_without_collected_frames_batches_are_the_loaders(make_replay, deliver, demonstrations, normalizer):
    replay = make_replay(fraction=0.9)
    order = [11, 0, 5, 4, 4]
    batch = deliver(order)
    replay.observe(batch)
    rows = replay.train_batch(batch, generator())
    assert rows[FRAME_INDEX].tolist() == order
    for position, row in enumerate(order):
        frame = demonstrations[row]
        for key in KEYS[1:]:
            expected = normalizer.normalize(key, frame[key])
            torch.testing.assert_close(rows[key][position], expected, rtol=0, atol=1e-6)
            assert torch.equal(rows[key][position], batch[key][position])
        last = int(demonstrations.meta.episodes["dataset_to_index"][int(frame["episode_index"])]) - 1
        steps = [min(row + k, last) for k in range(4)]
        chunk = torch.stack([normalizer.normalize("action", demonstrations[s]["action"]) for s in steps])
        torch.testing.assert_close(rows["action"][position], chunk, rtol=0, atol=1e-6)
        assert rows["action_is_pad"][position].tolist() == [row + k > last for k in range(4)]


def test_exchanged_rows_are_collected_frames_and_the_rest_the_loaders(
    make_replay, deliver, collected, normalizer, make_episode
):
    replay = make_replay(fraction=0.5)
    replay.extend(collected)
    batch = deliver([0, 1, 2, 3, 4] * 40)  # the loader knows episode 0 alone
    replay.observe(batch)
    rows = replay.train_batch(batch, generator())
    exchanged = rows[FRAME_INDEX] >= N_DEMONSTRATED
    assert torch.equal(rows[FRAME_INDEX][~exchanged], batch["index"][~exchanged])
    assert 0.35 < exchanged.float().mean() < 0.65
    assert set(rows[FRAME_INDEX][exchanged].tolist()) == set(range(N_DEMONSTRATED, N_DEMONSTRATED + 7))
    assert not set(range(5, N_DEMONSTRATED)) & set(rows[FRAME_INDEX].tolist())  # episodes that were left out
    raw = normalizer.unnormalize("observation.state", rows["observation.state"])
    episodes = raw[:, 0].round()
    assert set(episodes[exchanged].tolist()) == {100.0, 101.0} and (episodes[~exchanged] == 0).all()
    sources = [make_episode(number, length) for number, length in enumerate(COLLECTED)]
    for row, state, chunk, is_pad in zip(
        rows[FRAME_INDEX].tolist(),
        raw,
        normalizer.unnormalize("action", rows["action"]),
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
    meta = demonstrations.meta
    uniform, fixed = (
        Replay(DemonstrationFrames(config, meta, meta.stats), config, fraction) for fraction in (None, 0.5)
    )
    batch = deliver([0, 1, 5, 6] * 20)
    for replay in (uniform, fixed):
        replay.observe(batch)
        replay.extend([collected[1]])
        assert replay.collected_fraction == 0.0, "nothing to fill it with"
        replay.extend([collected[0]])
        rows = replay.train_batch(batch, generator())[FRAME_INDEX]
        assert set(rows[rows >= N_DEMONSTRATED].tolist()) == {N_DEMONSTRATED + COLLECTED[1]}
    assert fixed.collected_fraction == 0.5
    assert uniform.collected_fraction == pytest.approx(1 / ((5 - 3) + 0 + (7 - 3) + 1))


def test_batches_depend_on_the_generator_alone(make_replay, deliver, collected):
    replay = make_replay(fraction=0.5)
    replay.extend([collected[0]])
    batch = deliver(list(range(13)))
    replay.observe(batch)
    torch.manual_seed(1)
    first = replay.train_batch(batch, generator(3))[FRAME_INDEX]
    torch.manual_seed(2)
    assert torch.equal(replay.train_batch(batch, generator(3))[FRAME_INDEX], first)
    assert not torch.equal(replay.train_batch(batch, generator(4))[FRAME_INDEX], first)
    assert batch["index"].tolist() == list(range(13))  # the loader's batch is left alone


def test_held_out_batches_are_demonstrations(make_replay, deliver, collected):
    replay = make_replay(fraction=0.9)
    replay.extend([collected[0]])
    batch = deliver([1, 2])
    replay.demonstrations.observe(batch)
    assert replay.eval_batch(batch)[FRAME_INDEX].tolist() == [1, 2]
    assert replay.seen_episodes == set()


def test_history_is_raw_and_stays_in_its_episode(make_replay, deliver, collected, demonstrations):
    replay = make_replay()
    replay.extend([collected[0]])
    replay.observe(deliver([0]))
    history = replay.history(torch.tensor([0, 5, 7, 13, 15]), ["observation.state"], 2)["observation.state"]
    assert history.tolist() == [
        [[0, 0], [0, 0]],
        [[1, 0], [1, 0]],
        [[2, 0], [2, 1]],
        [[100, 0], [100, 0]],
        [[100, 1], [100, 2]],
    ]


def test_executed_future_and_its_mask(make_replay, deliver, collected, normalizer):
    replay = make_replay()
    replay.extend([collected[0]])
    replay.observe(deliver([0]))
    rows = torch.tensor([0, 3, 5, 13, 14])
    future = replay.executed_future(rows, ["observation.state"], 3)
    recorded = normalizer.normalize("action", replay.table.columns["action"])
    assert torch.equal(future.actions[0], recorded[0:3])
    assert torch.equal(future.actions[3], recorded[13:16])
    steps = [
        normalizer.unnormalize("observation.state", x)[:, 1].round().tolist()
        for x in (future.observation, future.later)
    ]
    assert steps == [[0, 3, 0, 0, 1], [3, 4, 0, 3, 3]]
    assert future.is_pad.tolist() == [False, True, True, False, True]


def test_a_batch_under_other_statistics_is_refused(make_replay, deliver):
    batch = deliver([0, 1, 7])
    batch["action"] = batch["action"] * 1.1
    with pytest.raises(ValueError, match="no known statistics"):
        make_replay().observe(batch)


def test_batches_are_the_same_after_a_resume(make_replay, deliver, journal, add, make_episode):
    """T grown round by round and T loaded from disk at once deliver the same numbers."""
    batch, grown = deliver(list(range(13)) * 4), make_replay(fraction=0.6)
    for round_number, lengths in enumerate([(4, 3), (6,), (1, 2, 5)]):
        add(journal, round_number, 0, *(make_episode(number, n) for number, n in enumerate(lengths)))
        grown.extend(journal.kept(round_number))
        journal.finish(round_number, {})
    resumed, again = make_replay(fraction=0.6), EpisodeJournal(journal.root)
    for round_number in range(len(again.reports())):
        resumed.extend(again.kept(round_number))
    for replay in (grown, resumed):
        replay.observe(batch)
        assert replay.n_collected_frames == 21
    for seed in range(3):
        one, other = (replay.train_batch(batch, generator(seed)) for replay in (grown, resumed))
        assert one.keys() == other.keys() and all(torch.equal(one[key], other[key]) for key in one)


def test_drawn_frames_are_those_of_a_plain_list(make_replay, deliver, collected):
    """The frames that a generator picks, spelled out."""
    replay = make_replay(fraction=0.5)
    replay.extend(collected)
    batch = deliver(list(range(13)))
    replay.observe(batch)
    expected, draws = batch["index"].clone(), generator(5)
    exchanged = torch.rand(13, generator=draws) < 0.5
    drawn = torch.randint(7, (int(exchanged.sum()),), generator=draws)
    expected[exchanged] = torch.arange(N_DEMONSTRATED, N_DEMONSTRATED + 7)[drawn]
    assert torch.equal(replay.train_batch(batch, generator(5))[FRAME_INDEX], expected)


def test_tasks_are_those_of_the_episodes(make_replay, collected):
    replay = make_replay()
    replay.extend(collected)
    assert replay.history(torch.tensor([0, 13, 16, 17]), [], 1)["task"] == [
        "a small task",
        "task 0",
        "task 0",
        "task 1",
    ]


def test_an_episode_without_one_of_the_features_is_refused(make_replay, journal, make_episode, make_record):
    episode = make_episode(0)
    record = make_record(episode)
    del episode.observations["observation.state"]
    journal.append(0, 0, episode, record)
    replay = make_replay()
    with pytest.raises(KeyError, match="observation.state"):
        replay.extend(journal.kept(0))
    assert replay.n_collected_frames == 0 and replay.collected_fraction == 0.0
