"""A run that goes on: from its checkpoint, after it was moved, in the middle of a round."""

import logging
import shutil
from copy import deepcopy

import pytest
import torch
import toy_run
from toy_run import EPISODES, ROUND_STEPS, SCALE, episodes_on_disk

from lerobot_agpd import agpd as algorithm
from lerobot_agpd.flag_checks import FlagError
from lerobot_agpd.replay.replay import FRAME_INDEX


def test_a_resumed_run_goes_on_where_its_checkpoint_was(start, tmp_path):
    first = start().train(until=4).save()
    resumed = start(first.checkpoint)
    assert resumed.agpd.progress.step == 4 and len(resumed.agpd.reports) == 1
    assert resumed.agpd.replay.n_collected_frames == first.agpd.replay.n_collected_frames
    assert resumed.agpd.strength == first.agpd.strength != SCALE
    assert resumed.agpd.progress.seen_episodes == [0, 1, 2]
    resumed.train(until=5), first.train(until=5)
    assert torch.equal(*(run.agpd.train_batch(run.batch())[FRAME_INDEX] for run in (first, resumed)))
    resumed.train(until=9)
    assert [report.step for report in resumed.agpd.reports] == ROUND_STEPS


def weights(run) -> dict[str, torch.Tensor]:
    return {key: value.clone() for key, value in run.policy.state_dict().items()}


def assert_same(left, right):
    assert left.keys() == right.keys() and all(torch.equal(left[key], right[key]) for key in left)


@pytest.fixture
def without_noise(monkeypatch):
    """Students whose training draws no numbers: LeRobot restores the generators of a resumed run, this loop not."""
    monkeypatch.setattr(toy_run, "STUDENT", {"use_vae": False, "dropout": 0.0})


@pytest.mark.usefixtures("without_noise")
def test_rounds_after_the_checkpoint_are_used_again_at_their_step(start):
    """Nothing is collected twice, and training goes on as it would have without the interruption."""
    first = start().train(until=2).save()
    checkpoint, optimizer = first.checkpoint, deepcopy(first.optimizer.state_dict())
    first.train(until=8)
    collected = episodes_on_disk(first.agpd)
    resumed = start(checkpoint)
    resumed.optimizer.load_state_dict(optimizer)
    assert resumed.agpd.progress.step == 2 and resumed.agpd.reports == []
    assert resumed.agpd.replay.n_collected_frames == 0, "what was collected later comes later"
    resumed.train(until=8)
    assert episodes_on_disk(resumed.agpd).keys() == collected.keys()
    assert resumed.agpd.reports == first.agpd.reports and resumed.agpd.progress.rounds == 2
    assert_same(weights(resumed), weights(first))
    resumed.train(until=9)
    assert len(resumed.agpd.reports) == 3


@pytest.mark.usefixtures("without_noise")
def test_a_run_without_a_checkpoint_is_repeated_with_its_episodes(start, tmp_path, caplog):
    """The original command with another output folder and the old folder of episodes."""
    first = start().train(until=7)
    collected = episodes_on_disk(first.agpd)
    caplog.set_level(logging.INFO)
    again = start(output_dir=tmp_path / "again", root=tmp_path / "run" / "agpd")
    assert "2 finished rounds of" in caplog.text and "enter T when training reaches them" in caplog.text
    again.train(until=7)
    assert "round 1 (collected before the interruption)" in caplog.text
    assert episodes_on_disk(again.agpd).keys() == collected.keys()
    assert_same(weights(again), weights(first))
    again.train(until=9).save()
    assert [report.step for report in again.agpd.reports] == ROUND_STEPS
    resumed = start(again.checkpoint, output_dir=tmp_path / "again", root=tmp_path / "run" / "agpd")
    assert resumed.agpd.journal.root == tmp_path / "run" / "agpd" and len(resumed.agpd.reports) == 3


def test_a_run_that_was_moved_finds_its_episodes(start, tmp_path):
    first = start().train(until=4).save()
    (tmp_path / "run").rename(tmp_path / "moved")
    moved = tmp_path / "moved" / first.checkpoint.relative_to(tmp_path / "run")
    resumed = start(moved)
    assert resumed.agpd.journal.root == tmp_path / "moved" / "agpd" and len(resumed.agpd.reports) == 1


def test_a_copy_without_its_episodes_does_not_write_into_the_originals(start, tmp_path):
    """Unless it is told to; with its episodes it goes on by itself."""
    first = start().train(until=4).save()
    copy = tmp_path / "copy" / first.checkpoint.relative_to(tmp_path / "run")
    shutil.copytree(first.checkpoint, copy)
    with pytest.raises(
        FlagError, match=rf"no {tmp_path}/copy/agpd.*--policy.replay.root={tmp_path}/run/agpd"
    ):
        start(copy)
    told = start(copy, root=tmp_path / "run" / "agpd")
    assert told.agpd.journal.root == tmp_path / "run" / "agpd"
    shutil.copytree(tmp_path / "run" / "agpd", tmp_path / "copy" / "agpd")
    assert start(copy).agpd.journal.root == tmp_path / "copy" / "agpd"


def test_checkpoints_in_another_folder_know_where_the_episodes_are(start, tmp_path, caplog):
    """LeRobot writes where --output_dir says; the checkpoints' configuration then names the episodes."""
    first = start().train(until=4).save()
    elsewhere = start(first.checkpoint, output_dir=tmp_path / "elsewhere")
    assert f"next checkpoints go to {tmp_path / 'elsewhere'}" in caplog.text
    assert elsewhere.agpd.journal.root == tmp_path / "run" / "agpd"
    assert elsewhere.policy.config.replay.root == str(tmp_path / "run" / "agpd")
    assert first.policy.config.replay.root is None


@pytest.mark.parametrize("strategy", ["guided", "rollin"])
def test_an_interrupted_round_is_continued(start, monkeypatch, strategy):
    run = start(collect={"strategy": strategy}).train(until=2).save()
    calls, classify = [], algorithm.classify

    def dying(episode, config):
        calls.append(episode.spec)
        if len(calls) == 4:
            raise KeyboardInterrupt
        return classify(episode, config)

    monkeypatch.setattr(algorithm, "classify", dying)
    with pytest.raises(KeyboardInterrupt):
        run.train(until=3)
    before = {record.number: record for record in run.records(0)}
    frames = episodes_on_disk(run.agpd)
    assert len(before) == 3 and run.agpd.journal.reports() == []

    checkpoint = run.agpd.run.output_dir / "checkpoints" / "000002" / "pretrained_model"
    resumed = start(checkpoint, collect={"strategy": strategy}).train(until=3)
    records = resumed.records(0)
    assert [record.number for record in records] == list(range(EPISODES))
    assert {number: repr(records[number]) for number in before} == {n: repr(r) for n, r in before.items()}
    after = episodes_on_disk(resumed.agpd)
    assert all(after[path].tobytes() == values.tobytes() for path, values in frames.items())
    assert len(calls) == 4 + EPISODES - 3, "no finished episode is rolled out again"
    specs = resumed.agpd.collector.specs(0, SCALE)
    assert [(r.seed, r.strength) for r in records] == [(spec.seed, spec.strength) for spec in specs]
    assert resumed.agpd.reports[0].total.generated == EPISODES
    n_frames = resumed.agpd.replay.n_collected_frames
    assert n_frames == sum(record.length for record in records if record.kept)
