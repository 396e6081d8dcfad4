"""Collected episodes on disk: interrupted, continued, finished, merged."""

import json
import sys
import weakref

import numpy as np
import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_agpd.cli import merge
from lerobot_agpd.replay.episode import Episode, EpisodeRecord, Ticket
from lerobot_agpd.replay.frames import FrameTable
from lerobot_agpd.replay.store import ReplayStore
from lerobot_agpd.replay.writer import EpisodeWriter

SCALE = 0.5


def episode(number, length=3, scale=SCALE, success=True) -> Episode:
    rng = np.random.default_rng(number)
    successes = np.zeros(length, dtype=bool)
    successes[-1] = success
    return Episode(
        ticket=Ticket(number, 1_000_000 + number, scale),
        task="a small task",
        observations={
            "observation.state": rng.normal(size=(length, 2)).astype(np.float32),
            "observation.environment_state": rng.normal(size=(length, 3)).astype(np.float32),
        },
        actions=rng.normal(size=(length, 2)).astype(np.float32),
        rewards=rng.normal(size=length).astype(np.float32),
        successes=successes,
        j=0.25 if scale else float("nan"),
        shift=float("nan"),
    )


def record(rollout: Episode) -> EpisodeRecord:
    ticket = rollout.ticket
    return EpisodeRecord(
        number=ticket.number,
        seed=ticket.seed,
        scale=ticket.scale,
        length=len(rollout),
        max_reward=rollout.max_reward,
        success=rollout.success,
        passed=bool(rollout.success),
        trivial=False,
        kept=bool(rollout.success),
        j=rollout.j,
        shift=rollout.shift,
    )


def same(left: EpisodeRecord, right: EpisodeRecord) -> bool:
    return left.to_json() == right.to_json()  # NaN is not equal to itself


@pytest.fixture
def store(tmp_path) -> ReplayStore:
    return ReplayStore(tmp_path / "agpd")


@pytest.fixture
def write(demonstrations):
    """Finishes a round from one list of episodes per process."""
    writer = EpisodeWriter(demonstrations.meta)

    def finish(store, number, *shares):
        for rank, rollouts in enumerate(shares):
            spool = store.spool(number, rank)
            for rollout in rollouts:
                spool.add(rollout, record(rollout))
            store.write_share(number, rank, lambda root, kept: writer.write(root, kept, number, "guided"))
        report = {"round": number, "episodes": [r.to_json() for r in store.records(number, len(shares))]}
        store.finish(number, len(shares), report)

    return finish


def equal_episodes(left: Episode, right: Episode) -> bool:
    arrays = [(left.observations[k], right.observations[k]) for k in right.observations]
    arrays += [
        (left.actions, right.actions),
        (left.rewards, right.rewards),
        (left.successes, right.successes),
    ]
    return left.task == right.task and all(np.array_equal(a, b) and a.dtype == b.dtype for a, b in arrays)


# ---- the spool ----


def test_episode_round_trip(tmp_path):
    rollout = episode(4)
    rollout.save(tmp_path / "e.npz")
    assert [path.name for path in tmp_path.iterdir()] == ["e.npz"]
    loaded = Episode.load(tmp_path / "e.npz", record(rollout))
    assert equal_episodes(loaded, rollout) and loaded.ticket == rollout.ticket and loaded.j == rollout.j
    rollout.successes = None
    rollout.save(tmp_path / "e.npz")
    assert Episode.load(tmp_path / "e.npz", record(rollout)).successes is None


def test_record_round_trip():
    entry = record(episode(1, scale=0.0)).to_json()
    assert entry["j"] is None and entry["shift"] is None
    assert "NaN" not in json.dumps(entry)
    again = EpisodeRecord.from_json(json.loads(json.dumps(entry)))
    assert np.isnan(again.j) and np.isnan(again.shift) and again.to_json() == entry


def test_spool_remembers(store):
    spool = store.spool(0, 0)
    rollouts = [episode(2), episode(0, length=5), episode(1, success=False)]
    for rollout in rollouts:
        spool.add(rollout, record(rollout))
    reopened = ReplayStore(store.root).spool(0, 0)
    assert list(reopened.records) == [2, 0, 1]
    assert all(same(reopened.records[r.ticket.number], record(r)) for r in rollouts)
    kept = list(reopened.kept())
    assert [rollout.ticket.number for rollout in kept] == [0, 2]
    assert equal_episodes(kept[0], rollouts[1]) and equal_episodes(kept[1], rollouts[0])


@pytest.mark.parametrize("cut", [1, 20, 60])
def test_spool_survives_a_truncated_last_line(store, cut):
    spool = store.spool(0, 0)
    for number in range(3):
        spool.add(episode(number), record(episode(number)))
    text = spool.log.read_text()
    spool.log.write_text(text[:-cut])
    continued = store.spool(0, 0)
    assert set(continued.records) == {0, 1}
    continued.add(episode(2), record(episode(2)))
    assert spool.log.read_text() == text
    assert set(store.spool(0, 0).records) == {0, 1, 2}


def test_arrays_without_a_record_do_not_count(store):
    """Killed between writing an episode's arrays and its record."""
    spool = store.spool(0, 0)
    episode(0).save(spool.arrays / "episode-000000.npz")
    (spool.arrays / "episode-000001.partial.npz").write_bytes(b"half")
    again = store.spool(0, 0)
    assert not again.records and not list(again.kept())
    again.add(episode(0), record(episode(0)))
    assert len(list(again.kept())) == 1


def test_kept_episodes_are_in_memory_one_at_a_time(store, write, monkeypatch):
    """The one that is being written, and the next one that is being read."""
    alive, load = [], Episode.load

    def watched(path, entry):
        loaded = load(path, entry)
        alive.append(weakref.ref(loaded))
        assert sum(reference() is not None for reference in alive) <= 2
        return loaded

    monkeypatch.setattr(Episode, "load", watched)
    write(store, 0, [episode(number) for number in range(5)])
    assert len(alive) == 5


# ---- rounds ----


def test_interrupted_round_is_continued_with_the_same_records(store, write):
    first = store.spool(0, 0)
    first.add(episode(0), record(episode(0)))
    store.write_share(0, 0, lambda root, kept: root.mkdir())  # killed after writing an unreadable dataset
    assert store.rounds() == []
    again = ReplayStore(store.root)
    assert same(again.spool(0, 0).records[0], record(episode(0)))
    write(again, 0, [episode(1, length=4)])
    (round_,) = again.rounds()
    assert [entry["number"] for entry in round_.report["episodes"]] == [0, 1]
    dataset = LeRobotDataset("local/x", root=round_.datasets[0])
    assert list(dataset.meta.episodes["length"]) == [3, 4]


def test_finished_round_holds_what_was_collected(store, write, demonstrations):
    share = [episode(0), episode(1, length=1), episode(2, success=False), episode(3, length=4, scale=0.0)]
    write(store, 0, share, [episode(0, length=2)])
    (round_,) = store.rounds()
    assert round_.number == 0 and [path.name for path in round_.datasets] == ["rank-0", "rank-1"]
    assert [entry["kept"] for entry in round_.report["episodes"]] == [True, True, False, True, True]
    dataset = LeRobotDataset("local/x", root=round_.datasets[0])
    kept = [share[0], share[1], share[3]]
    assert list(dataset.meta.episodes["length"]) == [3, 1, 4]
    for name in ("agpd.round", "agpd.scale", "agpd.strategy", "next.reward", "next.success", "next.done"):
        assert name in dataset.features
    assert all(dataset.features[k] == f for k, f in demonstrations.features.items())
    assert dataset.fps == demonstrations.fps
    row = 0
    for rollout in kept:
        for step in range(len(rollout)):
            frame = dataset[row]
            for key, values in rollout.observations.items():
                assert torch.equal(frame[key], torch.from_numpy(values[step]))
            assert torch.equal(frame["action"], torch.from_numpy(rollout.actions[step]))
            assert float(frame["next.reward"]) == float(rollout.rewards[step])
            assert bool(frame["next.success"]) == bool(rollout.successes[step])
            assert bool(frame["next.done"]) == (step == len(rollout) - 1)
            assert int(frame["agpd.round"]) == 0
            assert float(frame["agpd.scale"]) == rollout.ticket.scale
            assert frame["agpd.strategy"] == ("guided" if rollout.ticket.scale else "replay")
            assert frame["task"] == "a small task"
            row += 1
    assert row == len(dataset)


def test_finish_leaves_manifest_report_and_nothing_partial(store, write):
    write(store, 0, [episode(0)])
    write(store, 1, [episode(0, success=False)])
    names = sorted(path.name for path in store.root.iterdir())
    assert names == ["manifest.json", "round-000", "round-001"]
    assert sorted(path.name for path in (store.root / "round-000").iterdir()) == ["rank-0", "round.json"]
    assert sorted(path.name for path in (store.root / "round-001").iterdir()) == ["round.json"]
    manifest = json.loads((store.root / "manifest.json").read_text())
    assert manifest == {
        "rounds": [
            {"folder": "round-000", "datasets": ["rank-0"], "round": 0},
            {"folder": "round-001", "datasets": [], "round": 1},
        ]
    }
    assert [len(round_.datasets) for round_ in store.rounds()] == [1, 0]


def test_round_whose_manifest_was_not_written_is_found(store, write):
    write(store, 0, [episode(0)])
    before = (store.root / "manifest.json").read_text()
    write(store, 1, [episode(1)])
    (store.root / "manifest.json").write_text(before)
    assert [round_.number for round_ in store.rounds()] == [0, 1]
    (store.root / "manifest.json").unlink()
    assert [round_.number for round_ in store.rounds()] == [0, 1]


@pytest.mark.parametrize("content", ["", "{", "[]", "null", '{"rounds": 3}', '{"rounds": [{}]}', '{"a": 1}'])
def test_corrupted_manifest_is_named(store, content):
    store.root.mkdir()
    (store.root / "manifest.json").write_text(content)
    with pytest.raises(ValueError, match="manifest.json is not a manifest of collected rounds"):
        store.rounds()


def test_missing_round_is_named(store, write):
    write(store, 0, [episode(0)])
    write(store, 1, [episode(1)])
    (store.root / "round-000" / "round.json").unlink()
    with pytest.raises(ValueError, match="round-000"):
        store.rounds()


def test_a_store_without_rounds(store):
    assert store.rounds() == [] and store.merge("local/merged") is None
    assert not store.root.exists()


def test_merge_is_the_concatenation(store, write):
    write(store, 0, [episode(0), episode(1, length=2)], [episode(2, length=5)])
    write(store, 1, [episode(3, success=False)])
    write(store, 2, [episode(4, length=2)])
    store.merge("local/merged")
    merged = store.merge("local/merged")  # again: replaced, not appended
    assert sorted(p.name for p in store.root.glob("merged*")) == ["merged"]
    parts = [LeRobotDataset("local/x", root=path) for r in store.rounds() for path in r.datasets]
    frames = [part[i] for part in parts for i in range(len(part))]
    assert len(merged) == len(frames) == 12 and merged.num_episodes == 4
    for row, theirs in enumerate(frames):
        ours = merged[row]
        assert int(ours["index"]) == row
        for key in ("observation.state", "action", "next.reward", "agpd.round", "agpd.scale", "next.done"):
            assert torch.equal(ours[key], theirs[key])
        assert ours["agpd.strategy"] == theirs["agpd.strategy"] and ours["task"] == theirs["task"]


def test_the_command_merges_again(store, write, monkeypatch):
    write(store, 0, [episode(0), episode(1, length=2)])
    monkeypatch.setattr(sys, "argv", ["lerobot-agpd-merge", f"--root={store.root}", "--repo_id=me/collected"])
    merge.main()
    assert len(LeRobotDataset("me/collected", root=store.root / "merged")) == 5


def test_the_command_says_what_is_wrong(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["lerobot-agpd-merge", f"--root={tmp_path}"])
    with pytest.raises(SystemExit, match="holds no kept episode"):
        merge.main()
    with pytest.raises(ValueError, match="--root=.*is not a folder"):
        merge.MergeConfig(root=tmp_path / "nothing")
    with pytest.raises(ValueError, match="needs --repo_id"):
        merge.MergeConfig(root=tmp_path, push_to_hub=True)


# ---- the writer ----


def test_writer_refuses_another_shape(demonstrations, tmp_path):
    rollout = episode(0)
    rollout.observations["observation.state"] = np.zeros((3, 5), dtype=np.float32)
    with pytest.raises(ValueError, match=r"'observation.state' with shape \(5,\).*\(2,\)"):
        EpisodeWriter(demonstrations.meta).write(tmp_path / "d", [rollout], 0, "guided")


def test_writer_leaves_out_what_the_environment_does_not_deliver(demonstrations, tmp_path):
    rollout = episode(0)
    del rollout.observations["observation.state"]
    rollout.observations["observation.extra"] = np.zeros((3, 1), dtype=np.float32)
    rollout.successes, rollout.task = None, ""
    EpisodeWriter(demonstrations.meta).write(tmp_path / "d", [rollout], 7, "replay")
    dataset = LeRobotDataset("local/x", root=tmp_path / "d")
    absent = {"observation.state", "observation.extra", "next.success"}
    assert not absent & set(dataset.features) and {"action", "next.reward"} <= set(dataset.features)
    assert int(dataset[0]["agpd.round"]) == 7 and dataset[0]["task"] == "a small task"


def metadata(root, features):
    """Metadata of a dataset that declares these features."""
    return LeRobotDataset.create(
        "local/declared", fps=10, features=features, root=root, use_videos=False
    ).meta


def test_writer_takes_over_dtypes_that_can_hold_what_was_recorded(demonstrations, tmp_path):
    """float64 can; integers would cut float32 off and keep it, but have room for a success."""
    declared = {
        "observation.state": "float64",
        "action": "float64",
        "next.reward": "int64",
        "next.success": "int64",
    }
    features = {
        key: {**feature, "dtype": declared.get(key, feature["dtype"])}
        for key, feature in demonstrations.features.items()
        if key in (*declared, "observation.environment_state")
    }
    rollouts = [episode(0), episode(1, length=2)]
    EpisodeWriter(metadata(tmp_path / "declared", features)).write(tmp_path / "d", rollouts, 0, "guided")
    dataset = LeRobotDataset("local/x", root=tmp_path / "d")
    expected = {**declared, "next.reward": "float32", "observation.environment_state": "float32"}
    assert {key: dataset.features[key]["dtype"] for key in expected} == expected
    columns = {"action": "actions", "next.reward": "rewards", "next.success": "successes"}
    for key, name in columns.items():
        written = np.stack(
            [np.asarray(dataset.hf_dataset.with_format("numpy")[row][key]) for row in range(5)]
        )
        recorded = np.concatenate([getattr(rollout, name) for rollout in rollouts])
        np.testing.assert_array_equal(written.reshape(recorded.shape), recorded)
    frames = FrameTable.from_dataset(dataset, ["observation.state"])
    states = np.concatenate([rollout.observations["observation.state"] for rollout in rollouts])
    np.testing.assert_array_equal(frames.columns["observation.state"], states)


@pytest.mark.parametrize(
    ("shape", "names"),
    [((4, 6, 3), ["height", "width", "channels"]), ((3, 4, 6), ["channels", "height", "width"])],
)
def test_writer_takes_images_in_either_declared_layout(demonstrations, tmp_path, shape, names):
    features = {"observation.image": {"dtype": "image", "shape": shape, "names": names}}
    features["action"] = demonstrations.features["action"]
    rollout = episode(0)
    images = np.random.default_rng(0).integers(0, 256, (3, 4, 6, 3), dtype=np.uint8)
    rollout.observations = {"observation.image": images}
    writer = EpisodeWriter(metadata(tmp_path / "declared", features))
    writer.check({"observation.image": images[0]})
    writer.write(tmp_path / "d", [rollout], 0, "guided")
    dataset = LeRobotDataset("local/x", root=tmp_path / "d")
    for step in range(3):
        read = (dataset[step]["observation.image"] * 255).round().to(torch.uint8)
        assert torch.equal(read, torch.from_numpy(images[step]).permute(2, 0, 1))
    with pytest.raises(ValueError, match=r"'observation.image' with shape \(6, 4, 3\)"):
        writer.check({"observation.image": images[0].swapaxes(0, 1)})
