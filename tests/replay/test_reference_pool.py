"""The frames of T at which the adversary has the teacher's chunks."""

import pytest
import torch
from noting_teacher import STATE, NotingTeacher

from lerobot_agpd.replay.reference_pool import ReferencePool
from lerobot_agpd.replay.teacher_chunks import TeacherSampler


@pytest.fixture
def pool(small_replay):
    small_replay.see([0, 2])
    return make_pool(small_replay)


def make_pool(replay, batches=None, **process):
    sampler = TeacherSampler(NotingTeacher(), replay, n_chunk_steps=4)
    batches = [] if batches is None else batches
    return ReferencePool(sampler, replay, per_round=3, seed=7, batches=batches, **process)


def draw(pool, n_rounds=0, n_rows=99, seed=0):
    return pool.draw(n_rounds, n_rows, torch.Generator().manual_seed(seed))


def test_chunks_are_those_of_the_drawn_frames(pool):
    drawn = draw(pool)
    normalizer = pool.replay.demonstrations.normalizer
    steps = normalizer.unnormalize("action", drawn.chunk[:, : drawn.n_shared])
    states = pool.replay.table.columns[STATE][drawn.frame_index]
    noise = steps - states[:, None] - torch.arange(3.0)[None, :, None]
    assert ((noise > -1e-4) & (noise < 1.0001)).all() and drawn.n_shared == 3
    assert not drawn.chunk[:, 3:].any()


def test_the_pool_grows_with_the_rounds_and_samples_every_frame_once(pool, stored):
    assert len(draw(pool).frame_index) == 3 and len(draw(pool, n_rows=2).frame_index) == 2
    pool.replay.extend(stored(3, 4))
    assert len(draw(pool).frame_index) == 3, "a round that is not in T yet"
    drawn = draw(pool, n_rounds=2)
    assert len(drawn.frame_index) == len(set(drawn.frame_index.tolist())) == 9
    assert pool.sampler.take_count() == 9 == len(pool.sampler.teacher.sampled)
    assert not set(drawn.frame_index.tolist()) & {5}, "episode 1 was never delivered"


def test_a_small_replay_gives_all_that_it_has(pool):
    assert len(draw(pool, n_rounds=20).frame_index) == 5 + 7


def test_a_run_that_goes_on_has_the_same_pool(pool, stored):
    draw(pool), pool.replay.extend(stored(3, 4))
    expected = draw(pool, 1, seed=3)
    again = make_pool(pool.replay, [list(batch) for batch in pool.batches])
    pool.replay.see([1])  # more than the first run had seen when its frames were chosen
    found = draw(again, 1, seed=3)
    assert torch.equal(found.frame_index, expected.frame_index)
    assert torch.equal(found.chunk, expected.chunk)


def test_rounds_before_the_adversary_acts_are_made_up_for(small_replay):
    late = make_pool(small_replay)
    assert len(draw(late, n_rounds=1).frame_index) == 5, "6 of the 5 frames that were seen"
    assert [len(batch) for batch in late.batches] == [0, 5]


def test_new_noise_for_every_batch(pool):
    first, later = draw(pool), draw(pool, 1)
    assert len(later.frame_index) == 6
    kept = torch.isin(later.frame_index, first.frame_index)
    assert kept.sum() == 3
    values = {int(frame): chunk for frame, chunk in zip(first.frame_index, first.chunk, strict=True)}
    for frame, chunk in zip(later.frame_index[kept], later.chunk[kept], strict=True):
        assert torch.equal(values[int(frame)], chunk)


def test_processes_share_the_frames_and_go_on_in_any_number(pool, stored):
    parts = [make_pool(pool.replay, rank=rank, n_ranks=2) for rank in (0, 1)]
    drawn = [set(draw(part).frame_index.tolist()) for part in parts]
    assert sorted(map(len, drawn)) == [1, 2] and drawn[0] | drawn[1] == set(draw(pool).frame_index.tolist())
    assert parts[0].batches == parts[1].batches == pool.batches
    pool.replay.extend(stored(3, 4))
    alone = make_pool(pool.replay, parts[0].batches)
    assert set(draw(alone).frame_index.tolist()) == drawn[0] | drawn[1]
    many = [make_pool(pool.replay, [[4]], rank=rank, n_ranks=3) for rank in range(3)]
    chunks = [
        draw(part).chunk for part in many
    ]  # fewer frames than processes: all have them, with other noise
    assert [len(chunk) for chunk in chunks] == [1, 1, 1] and not torch.equal(chunks[0], chunks[1])
