"""The teacher's own chunks on T."""

import pytest
import torch
from noting_teacher import NotingTeacher

from lerobot_agpd.replay.chunk_store import ChunkStore
from lerobot_agpd.replay.teacher_chunks import TeacherChunks, TeacherSampler


@pytest.fixture
def chunks(small_replay):
    return make_chunks(small_replay)


def make_chunks(replay):
    return TeacherChunks(TeacherSampler(NotingTeacher(), replay, n_chunk_steps=4), replay, seed=7)


def raw(chunks, frames, seen=()):
    """The teacher's steps in raw units, and the others, after the loader has delivered the episodes `seen`."""
    chunks.replay.see(seen)
    found, shared = chunks.at(torch.tensor(frames))
    normalizer = chunks.replay.demonstrations.normalizer
    return normalizer.unnormalize("action", found[:, :shared]), found[:, shared:]


def test_chunks_are_the_teachers_and_zero_beyond_its_own(chunks):
    found, beyond = raw(chunks, [0, 4, 6], {0})
    expected = torch.tensor([[0.0, 0.0], [0.0, 4.0], [2.0, 0.0]])[:, None] + torch.arange(3.0)[None, :, None]
    assert (
        found.shape == (3, 3, 2)
        and ((found - expected) > -1e-4).all()
        and ((found - expected) < 1.0001).all()
    )
    assert beyond.shape == (3, 1, 2) and not beyond.any()


def test_noise_is_the_episodes_own(chunks, demonstrations):
    """Seeded by the episode's first frame: when it is sampled does not matter."""
    found, _ = raw(chunks, [6, 8])
    noise = torch.rand((7, 5, 2), generator=torch.Generator().manual_seed(7 + 6))
    states = torch.tensor([[2.0, 0.0], [2.0, 2.0]])[:, None] + torch.arange(3.0)[None, :, None]
    torch.testing.assert_close(found, states + noise[[0, 2], :3], rtol=0, atol=1e-4)
    other = make_chunks(chunks.replay)
    raw(other, [0], {0, 1})
    assert torch.equal(raw(other, [6, 8])[0], found)


def test_every_frame_is_sampled_once(chunks, stored):
    """With its episode, when one of that is asked for."""
    sampled = chunks.sampler.teacher.sampled
    raw(chunks, [0], {0})
    assert sampled == [(0, step) for step in range(5)]
    chunks.replay.extend(stored(3, 2))
    before, _ = raw(chunks, [1])
    assert len(sampled) == 5 == chunks.sampler.take_count()
    raw(chunks, [13, 17], {0, 2})
    assert len(sampled) == 5 + 3 + 2 and len(set(sampled)) == 10
    raw(chunks, list(range(5)) + list(range(6, 18)), {0, 2})
    assert len(sampled) == 17 and chunks.sampler.take_count() == 12
    assert torch.equal(raw(chunks, [1])[0], before), "growth keeps what is there"


class TestStore:
    """Chunks on disk are used again, by a process that would sample the same."""

    @pytest.fixture
    def make(self, small_replay, tmp_path):
        def make(writes=True, **identity):
            store = ChunkStore(tmp_path, identity, writes)
            sampler = TeacherSampler(NotingTeacher(), small_replay, n_chunk_steps=4)
            return TeacherChunks(sampler, small_replay, seed=7, store=store)

        return make

    def test_the_teacher_is_asked_once(self, make):
        first, second = make(), make()
        found, _ = raw(first, [0, 6], {0, 2})
        assert torch.equal(raw(second, [0, 6], {0, 2})[0], found)
        assert first.sampler.teacher.sampled and not second.sampler.teacher.sampled

    def test_another_teacher_is_asked_anew(self, make):
        first, second = make(path="a"), make(path="b")
        raw(first, [0], {0})
        raw(second, [0], {0})
        assert second.sampler.teacher.sampled == first.sampler.teacher.sampled != []

    def test_a_damaged_or_unfitting_file_is_replaced(self, make):
        first = make()
        found, _ = raw(first, [0], {0})
        (path,) = first.store.folder.glob("*.npy")
        whole = path.read_bytes()
        for content in (b"", whole[: len(whole) // 2]):
            path.write_bytes(content)
            again = make()
            assert torch.equal(raw(again, [0], {0})[0], found) and again.sampler.teacher.sampled
            assert path.read_bytes() == whole

    def test_other_processes_read_only(self, make):
        other = make(writes=False)
        raw(other, [0], {0})
        assert not other.store.folder.exists()
        raw(make(), [0], {0})
        reader = make(writes=False)
        raw(reader, [0], {0})
        assert not reader.sampler.teacher.sampled
