"""The journal as a LeRobotDataset."""

import json
import shutil
import sys

import numpy as np
import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_agpd.cli import merge as command
from lerobot_agpd.flag_checks import FlagError
from lerobot_agpd.replay.export import check_observation, merge
from lerobot_agpd.replay.frames import FrameTable
from lerobot_agpd.replay.journal import EpisodeJournal


def declared(journal, tmp_path, features):
    """A journal of demonstrations with these features."""
    root = tmp_path / "declared"
    dataset = LeRobotDataset.create("local/declared", fps=10, features=features, root=root, use_videos=False)
    header = {"fps": 10, "robot_type": None, "features": dataset.meta.features, "task": "a small task"}
    other = EpisodeJournal(tmp_path / "other")
    other.root.mkdir()
    content = {**header, "identity": {"strategy": "guided"}}
    (other.root / "journal.json").write_text(json.dumps(content))
    return other


def test_merge_equals_what_the_journal_holds(journal, add, make_episode, demonstrations):
    first = [make_episode(0), make_episode(1, length=1), make_episode(2, success=False)]
    second = [make_episode(3, length=4, strength=0.0), make_episode(4, strength=0.0, student_steps=2)]
    add(journal, 0, 0, *first)
    add(journal, 0, 1, *second)
    journal.finish(0, {})
    add(journal, 1, 0, make_episode(5, length=2))  # this round goes on
    kept = [
        (0, first[0]),
        (0, first[1]),
        *((0, episode) for episode in second),
        (1, make_episode(5, length=2)),
    ]
    dataset = merge(journal.root)
    assert dataset.repo_id == "agpd/run" and dataset.root == journal.root / "merged"
    assert list(dataset.meta.episodes["length"]) == [len(episode) for _, episode in kept]
    assert all(dataset.features[key] == feature for key, feature in demonstrations.features.items())
    assert dataset.fps == demonstrations.fps
    frames = iter(dataset[row] for row in range(len(dataset)))
    for round_number, episode in kept:
        strategy = "guided" if episode.spec.strength or episode.student_steps else "teacher"
        for step in range(len(episode)):
            frame = next(frames)
            for key, values in episode.columns.items():
                assert torch.equal(frame[key].reshape(-1), torch.from_numpy(values[step].reshape(-1)))
            assert bool(frame["next.done"]) == (step == len(episode) - 1)
            assert int(frame["agpd.round"]) == round_number
            assert float(frame["agpd.strength"]) == episode.spec.strength
            assert frame["agpd.strategy"] == strategy and frame["task"] == episode.task
    assert next(frames, None) is None


def test_merging_again_replaces(journal, add, make_episode):
    add(journal, 0, 0, make_episode(0))
    assert len(merge(journal.root, "local/merged")) == 3
    for left in ("new", "replaced"):  # by attempts that were killed
        shutil.copytree(journal.root / "merged", journal.root / f"merged.{left}")
    add(journal, 0, 0, make_episode(1))
    assert len(merge(journal.root, "local/merged")) == 6
    assert [path.name for path in journal.root.glob("merged*")] == ["merged"]
    assert len(journal.kept(0)) == 2


@pytest.mark.parametrize("name", ["merged", "merged.new", "merged.replaced"])
def test_a_foreign_folder_is_not_deleted(journal, add, make_episode, demonstrations, name):
    add(journal, 0, 0, make_episode(0))
    merged = journal.root / name
    merged.mkdir()
    (merged / "thesis.txt").write_text("mine")
    with pytest.raises(ValueError, match=f"{name} exists"):
        merge(journal.root)
    (merged / "meta").mkdir()
    (merged / "meta" / "info.json").write_text((demonstrations.root / "meta" / "info.json").read_text())
    with pytest.raises(ValueError, match=f"{name} exists"):
        merge(journal.root)
    assert (merged / "thesis.txt").exists()


def test_nothing_kept_nothing_merged(journal, add, make_episode, tmp_path):
    add(journal, 0, 0, make_episode(0, success=False))
    assert merge(journal.root) is None and merge(tmp_path / "none") is None
    assert not (journal.root / "merged").exists()


def test_the_command_merges_again(journal, add, make_episode, monkeypatch):
    add(journal, 0, 0, make_episode(0), make_episode(1, length=2))
    monkeypatch.setattr(
        sys, "argv", ["lerobot-agpd-merge", f"--root={journal.root}", "--repo_id=me/collected"]
    )
    for _ in range(2):
        command.main()
    assert len(LeRobotDataset("me/collected", root=journal.root / "merged")) == 5


def test_the_command_says_what_is_wrong(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["lerobot-agpd-merge", f"--root={tmp_path}"])
    with pytest.raises(SystemExit, match="holds no kept episode"):
        command.main()
    with pytest.raises(FlagError, match="--root=.*is not a folder"):
        command.MergeConfig(root=tmp_path / "nothing")
    with pytest.raises(FlagError, match="needs --repo_id"):
        command.MergeConfig(root=tmp_path, push_to_hub=True)


# ---- what the demonstrations declare ----


def test_another_shape_is_refused(journal, add, make_episode):
    episode = make_episode(0)
    episode.observations["observation.state"] = np.zeros((3, 5), dtype=np.float32)
    add(journal, 0, 0, episode)
    with pytest.raises(ValueError, match=r"'observation.state' with shape \(5,\).*\(2,\)"):
        merge(journal.root)
    with pytest.raises(ValueError, match=r"'observation.state' with shape \(5,\).*\(2,\)"):
        check_observation(journal.header["features"], {"observation.state": np.zeros(5, dtype=np.float32)})


def test_what_the_environment_does_not_deliver_is_left_out(journal, add, make_episode, make_record):
    episode = make_episode(0, task="")
    record = make_record(episode)
    del episode.observations["observation.state"]
    episode.observations["observation.extra"] = np.zeros((3, 1), dtype=np.float32)
    episode.successes = None
    journal.append(7, 0, episode, record)
    dataset = merge(journal.root)
    absent = {"observation.state", "observation.extra", "next.success"}
    assert not absent & set(dataset.features) and {"action", "next.reward"} <= set(dataset.features)
    assert int(dataset[0]["agpd.round"]) == 7 and dataset[0]["task"] == "a small task"


def test_dtypes_that_can_hold_what_was_recorded(journal, add, make_episode, demonstrations, tmp_path):
    """float64 can; integers would cut float32 off and keep it, but have room for a success."""
    changed = {
        "observation.state": "float64",
        "action": "float64",
        "next.reward": "int64",
        "next.success": "int64",
    }
    features = {
        key: {**feature, "dtype": changed.get(key, feature["dtype"])}
        for key, feature in demonstrations.features.items()
        if key in (*changed, "observation.environment_state")
    }
    journal, episodes = declared(journal, tmp_path, features), [make_episode(0), make_episode(1, length=2)]
    add(journal, 0, 0, *episodes)
    dataset = merge(journal.root)
    expected = {**changed, "next.reward": "float32", "observation.environment_state": "float32"}
    assert {key: dataset.features[key]["dtype"] for key in expected} == expected
    for key in ("action", "next.reward", "next.success"):
        rows = dataset.hf_dataset.with_format("numpy")
        written = np.stack([np.asarray(rows[row][key]) for row in range(5)])
        recorded = np.concatenate([episode.columns[key] for episode in episodes])
        np.testing.assert_array_equal(written.reshape(recorded.shape), recorded)
    states = np.concatenate([episode.observations["observation.state"] for episode in episodes])
    frames = FrameTable.from_dataset(dataset, ["observation.state"])
    np.testing.assert_array_equal(frames.columns["observation.state"], states)


@pytest.mark.parametrize(
    ("shape", "names"),
    [((4, 6, 3), ["height", "width", "channels"]), ((3, 4, 6), ["channels", "height", "width"])],
)
def test_images_in_either_declared_layout(journal, add, make_episode, demonstrations, tmp_path, shape, names):
    features = {"observation.image": {"dtype": "image", "shape": shape, "names": names}}
    features["action"] = demonstrations.features["action"]
    images = np.random.default_rng(0).integers(0, 256, (3, 4, 6, 3), dtype=np.uint8)
    journal = declared(journal, tmp_path, features)
    check_observation(journal.header["features"], {"observation.image": images[0]})
    add(journal, 0, 0, make_episode(0, observations={"observation.image": images}))
    dataset = merge(journal.root)
    for step in range(3):
        read = (dataset[step]["observation.image"] * 255).round().to(torch.uint8)
        assert torch.equal(read, torch.from_numpy(images[step]).permute(2, 0, 1))
    with pytest.raises(ValueError, match=r"'observation.image' with shape \(6, 4, 3\)"):
        check_observation(journal.header["features"], {"observation.image": images[0].swapaxes(0, 1)})
