"""Collected episodes on disk: interrupted at any point, continued, finished, damaged."""

import json
import logging
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st
from hypothesis.extra.numpy import arrays

from lerobot_agpd.files import write_array
from lerobot_agpd.replay import stored as stored_module
from lerobot_agpd.replay.episode import Episode, EpisodeRecord, EpisodeSpec
from lerobot_agpd.replay.journal import EpisodeJournal
from lerobot_agpd.replay.stored import MAX_OPEN_FILES

IDENTITY = {"strategy": "guided", "environment": {"type": "a", "task": "b"}, "teacher": "t", "seed": 1}


def same(left, right) -> bool:
    return [r.to_json() for r in left] == [r.to_json() for r in right]  # NaN is not equal to itself


def assert_holds(stored, episode):
    assert len(stored) == len(episode) and set(stored.keys) == set(episode.columns)
    assert set(stored.observations) == set(episode.observations)
    for key, values in episode.columns.items():
        column = stored.column(key)
        assert column.dtype == values.dtype
        np.testing.assert_array_equal(column, values)
        for step in range(len(episode)):
            np.testing.assert_array_equal(stored.frame(key, step), values[step])


# ---- episodes ----


def test_record_round_trip(make_episode, make_record):
    entry = make_record(make_episode(1, strength=0.0)).to_json()
    assert entry["discrepancy"] is None and entry["guidance_shift"] is None
    assert "NaN" not in json.dumps(entry)
    again = EpisodeRecord.from_json(json.loads(json.dumps(entry)))
    assert np.isnan(again.discrepancy) and np.isnan(again.guidance_shift) and again.to_json() == entry


def test_an_episode_without_strength_is_the_teachers():
    assert EpisodeSpec(0, 1, 0.0).teacher_only and not EpisodeSpec(0, 1, 0.5).teacher_only


def test_an_episode_says_whether_it_succeeded(make_episode):
    assert make_episode(0).is_success is True and make_episode(0, success=False).is_success is False
    assert replace(make_episode(0), successes=None).is_success is None


# ---- random access ----


def test_what_is_read_is_what_was_recorded(journal, add, make_episode):
    images = np.random.default_rng(0).integers(0, 256, (2, 4, 6, 3), dtype=np.uint8)
    first, second = make_episode(3, length=5), make_episode(0, length=2)
    second.observations = {"observation.image": images, "observation.wrist": 255 - images}
    second.successes = None
    add(journal, 0, 0, first)
    journal.append(0, 0, second, replace(EpisodeRecord.from_json(_entry(second)), kept=True))
    stored = EpisodeJournal(journal.root).kept(0)
    assert [episode.record.number for episode in stored] == [0, 3] and stored[1].task == "task 3"
    assert_holds(stored[0], second)
    assert_holds(stored[1], first)
    assert all(isinstance(stored[0].column(key), np.memmap) for key in second.columns)
    with pytest.raises(KeyError, match="next.success"):
        stored[0].column("next.success")


def _entry(episode):
    return {
        "number": episode.spec.number,
        "seed": 0,
        "strength": 0.0,
        "length": len(episode),
        "max_reward": 0.0,
        "is_success": None,
        "success": True,
        "solved_at_start": False,
        "kept": True,
        "discrepancy": None,
        "guidance_shift": None,
    }


@given(data=st.data())
@settings(deadline=None, max_examples=20, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_property_any_episode_round_trips(data, tmp_path_factory, demonstrations):
    n_steps = data.draw(st.integers(1, 6))
    floats = st.floats(width=32, allow_nan=False)
    draw = lambda kind, *shape: data.draw(arrays(kind, (n_steps, *shape), elements=floats))  # noqa: E731
    pixels = data.draw(arrays(np.uint8, (n_steps, 2, 3, 3)))
    episode = Episode(
        EpisodeSpec(7, 0, 0.0),
        "task",
        {"observation.state": draw(np.float32, 2), "observation.image": pixels},
        draw(np.float32, 1),
        draw(np.float32),
        data.draw(arrays(bool, n_steps)),
    )
    journal = EpisodeJournal(tmp_path_factory.mktemp("journal"))
    journal.begin(demonstrations.meta, IDENTITY)
    journal.append(0, 0, episode, EpisodeRecord.from_json(_entry(episode)))
    (stored,) = journal.kept(0)
    assert_holds(stored, episode)


def test_large_arrays_are_written_in_blocks(tmp_path, monkeypatch):
    monkeypatch.setattr("lerobot_agpd.files.BLOCK_BYTES", 100)
    rng = np.random.default_rng(0)
    vectors = {"a": rng.normal(size=(17, 3)), "b": np.arange(17)}
    write_array(tmp_path / "vectors.npy", vectors)
    write_array(tmp_path / "images.npy", rng.integers(0, 256, (17, 5, 4, 3), dtype=np.uint8).swapaxes(1, 2))
    read = np.load(tmp_path / "vectors.npy", allow_pickle=False)
    assert all(np.array_equal(read[key], values) for key, values in vectors.items())
    rng = np.random.default_rng(0)
    rng.normal(size=(17, 3))
    images = rng.integers(0, 256, (17, 5, 4, 3), dtype=np.uint8).swapaxes(1, 2)
    np.testing.assert_array_equal(np.load(tmp_path / "images.npy"), images)


def test_few_files_are_open_at_a_time(journal, add, make_episode):
    open_files = lambda: len(os.listdir("/proc/self/fd"))  # noqa: E731
    add(journal, 0, 0, *(make_episode(number, length=1) for number in range(MAX_OPEN_FILES + 30)))
    stored_module._memory_mapped.cache_clear()
    before = open_files()
    for episode in journal.kept(0):
        episode.frame("action", 0)
    assert open_files() - before <= MAX_OPEN_FILES


def test_an_episode_without_a_task_has_the_demonstrations(journal, add, make_episode):
    add(journal, 0, 0, make_episode(0, task=""))
    assert journal.kept(0)[0].task == "a small task"


# ---- rounds ----


def test_all_processes_episodes_ordered_by_number(journal, add, make_episode, make_record):
    episodes = [make_episode(number, 1 + number % 3) for number in range(12)]
    for number, rank in [(3, 10), (1, 0), (11, 2), (0, 2), (2, 0), (9, 10), (10, 1)]:
        add(journal, 0, rank, episodes[number])
    present = [episodes[number] for number in (0, 1, 2, 3, 9, 10, 11)]
    assert same(journal.records(0), [make_record(episode) for episode in present])
    assert journal.records(1) == []
    for stored, episode in zip(journal.kept(0), present, strict=True):
        assert_holds(stored, episode)


def test_only_kept_episodes_have_frames(journal, add, make_episode):
    add(journal, 0, 0, make_episode(0), make_episode(1, success=False))
    assert [record.kept for record in journal.records(0)] == [True, False]
    assert [episode.record.number for episode in journal.kept(0)] == [0]
    names = sorted(path.name for path in (journal.root / "round-00000").iterdir())
    assert names == ["rank-0-000000.npy", "rank-0.jsonl"]


def test_a_report_makes_a_round_finished(journal, add, make_episode):
    add(journal, 0, 0, make_episode(0))
    assert journal.reports() == []
    journal.finish(0, {"round": 0})
    add(journal, 1, 0, make_episode(1), make_episode(2))
    assert EpisodeJournal(journal.root).reports() == [{"round": 0}]
    assert [(number, e.record.number) for number, e in journal.stored()] == [(0, 0), (1, 1), (1, 2)]


def test_rounds_beyond_any_width(journal, add, make_episode, monkeypatch):
    monkeypatch.setattr("os.fsync", lambda descriptor: None)  # a thousand of them take long
    for number in (99_999, 100_000):
        add(journal, number, 0, make_episode(number))
    assert [number for number, _ in journal.stored()] == [99_999, 100_000]
    for number in range(1_002):
        journal.finish(number, {"round": number})
    assert [report["round"] for report in journal.reports()] == list(range(1_002))


def test_a_gap_is_named(journal):
    for number in (0, 2):
        journal.finish(number, {})
    with pytest.raises(ValueError, match="round-00001"):
        journal.reports()


def test_a_journal_that_was_not_begun(tmp_path):
    journal = EpisodeJournal(tmp_path / "none")
    assert not journal.exists and journal.reports() == [] and list(journal.stored()) == []
    assert not journal.root.exists()


# ---- the run ----


def test_another_runs_episodes_are_refused(journal, demonstrations):
    again = EpisodeJournal(journal.root)
    again.begin(demonstrations.meta, IDENTITY)
    with pytest.raises(ValueError, match=r"seed 1 instead of 2.*--policy.replay.root.*--resume=true"):
        again.begin(demonstrations.meta, {**IDENTITY, "seed": 2})
    again.begin(demonstrations.meta, {**IDENTITY, "seed": 2}, resume=True)
    with pytest.raises(ValueError, match=r"student None instead of"):
        again.begin(demonstrations.meta, {**IDENTITY, "student": Path("s")})
    assert EpisodeJournal(journal.root).header["identity"] == IDENTITY


def test_the_header_describes_the_demonstrations(journal, demonstrations):
    header = EpisodeJournal(journal.root).header
    assert header["fps"] == demonstrations.fps and header["task"] == "a small task"
    assert set(header["features"]) == set(demonstrations.features)


# ---- killed processes ----


class Killed(BaseException):
    """Ends a process at a chosen write."""


def killed_at(monkeypatch, call):
    """Let the `call`th sync or rename end the process, before it happens."""
    calls = iter(range(call))
    real = {"fsync": os.fsync, "replace": os.replace}

    def dying(name):
        def act(*args):
            if next(calls, None) is None:
                raise Killed
            return real[name](*args)

        return act

    monkeypatch.setattr("os.fsync", dying("fsync"))
    monkeypatch.setattr("pathlib.Path.replace", lambda path, target: dying("replace")(path, target))


def collect(journal, episodes, make_record):
    """What a round does: append what is missing, then finish."""
    present = {record.number for record in journal.records(0)}
    for episode in episodes:
        if episode.spec.number not in present:
            journal.append(0, 0, episode, make_record(episode))
    journal.finish(0, {"episodes": len(episodes)})


@pytest.mark.parametrize("call", range(0, 40))
def test_killed_between_any_two_writes(
    call, tmp_path, demonstrations, make_episode, make_record, monkeypatch
):
    episodes = [make_episode(0), make_episode(1, success=False), make_episode(2, length=4)]
    episodes[2].observations["observation.image"] = np.full((4, 2, 2, 3), 9, dtype=np.uint8)
    journal = EpisodeJournal(tmp_path)
    with monkeypatch.context() as patched:
        killed_at(patched, call)
        try:
            journal.begin(demonstrations.meta, IDENTITY)
            collect(journal, episodes, make_record)
            ended = True
        except Killed:
            ended = False
    finished = bool(journal.reports())
    assert finished or not ended
    for stored in journal.kept(0) if journal.exists else []:
        assert_holds(stored, episodes[stored.record.number])
    again = EpisodeJournal(tmp_path)
    again.begin(demonstrations.meta, IDENTITY)
    if not finished:
        collect(again, episodes, make_record)
    assert again.reports() == [{"episodes": 3}]
    assert same(again.records(0), [make_record(episode) for episode in episodes])
    for stored, episode in zip(again.kept(0), (episodes[0], episodes[2]), strict=True):
        assert_holds(stored, episode)
    assert call < 30 or finished, "the numbers cover all writes"


@pytest.mark.parametrize("cut", [1, 20, 60, 250])
def test_a_torn_last_record_is_left_out_and_written_again(journal, add, make_episode, cut, caplog):
    add(journal, 0, 0, *(make_episode(number) for number in range(3)))
    index = journal.root / "round-00000" / "rank-0.jsonl"
    text = index.read_bytes()
    index.write_bytes(text[:-cut])
    with caplog.at_level(logging.WARNING):
        assert [record.number for record in journal.records(0)] == [0, 1]
    assert str(index) in caplog.text
    assert index.read_bytes() == text[:-cut], "a reader changes nothing: the line may be in the making"
    add(journal, 0, 0, make_episode(2))
    assert index.read_bytes() == text


def test_a_finished_round_holds_nothing_half_written(journal, add, make_episode):
    """Frames without a record and torn lines of processes that are no more; what is not ours stays."""
    add(journal, 0, 0, make_episode(0), make_episode(2, success=False))
    add(journal, 0, 1, make_episode(1))
    folder = journal.root / "round-00000"
    for name in ("rank-1-000002.npy", "rank-1-000003.npy.partial", "rank-1-000003.observation.image.npy"):
        (folder / name).write_bytes(b"half")
    (folder / "notes.txt").write_text("mine")
    (folder / "my-rank-1-000002.npy").write_text("mine")
    index = folder / "rank-1.jsonl"
    index.write_bytes(index.read_bytes() + b'{"number": 2, "se')
    records = journal.records(0)
    journal.finish(0, {})
    assert sorted(path.name for path in folder.iterdir()) == [
        "my-rank-1-000002.npy",
        "notes.txt",
        "rank-0-000000.npy",
        "rank-0.jsonl",
        "rank-1-000001.npy",
        "rank-1.jsonl",
        "report.json",
    ]
    assert index.read_bytes().endswith(b"\n") and same(journal.records(0), records)
    assert len(journal.kept(0)) == 2


# ---- damage ----


@pytest.mark.parametrize("line", ["{", "[]", "null", "3", '{"number": 1}', '{"torn', "\x00\x00"])
def test_a_damaged_record_in_the_middle_is_named(journal, add, make_episode, line):
    add(journal, 0, 0, *(make_episode(number) for number in range(3)))
    index = journal.root / "round-00000" / "rank-0.jsonl"
    lines = index.read_text().splitlines()
    index.write_text("\n".join([lines[0], line, lines[2]]) + "\n")
    with pytest.raises(ValueError, match=r"line 2 of .*rank-0.jsonl.*delete the line"):
        journal.records(0)


@pytest.mark.parametrize("damage", ["missing", "empty", "truncated", "other length", "pickle"])
def test_unreadable_frames_are_named(journal, add, make_episode, damage):
    add(journal, 0, 0, make_episode(0, length=200))
    path = journal.root / "round-00000" / "rank-0-000000.npy"
    if damage == "missing":
        path.unlink()
    elif damage == "other length":
        np.save(path, np.load(path)[:-1])
    elif damage == "pickle":
        np.save(path, np.array([{}], dtype=object))
    else:
        path.write_bytes(path.read_bytes()[: 0 if damage == "empty" else 1000])
    (stored,) = journal.kept(0)
    with pytest.raises(ValueError, match=r'rank-0-000000.npy .*"number": 0 .*rank-0.jsonl'):
        stored.column("action")


@pytest.mark.parametrize("content", ["", "{", "[]", "null"])
@pytest.mark.parametrize("name", ["journal.json", "round-00000/report.json"])
def test_unreadable_documents_are_named(journal, name, content):
    journal.finish(0, {})
    (journal.root / name).write_text(content)
    again = EpisodeJournal(journal.root)
    with pytest.raises(ValueError, match=f"{name} .*restore it"):
        _ = again.reports(), again.header
