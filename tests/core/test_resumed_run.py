"""A run that goes on: from its checkpoint, after it was moved, in the middle of a round."""

import pytest
import torch
from toy_run import EPISODES, ROUND_STEPS, SCALE, episodes_on_disk

from lerobot_agpd import agpd as algorithm
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


def test_rounds_after_the_checkpoint_are_adopted_and_not_collected_twice(start):
    first = start().train(until=4).save()
    checkpoint = first.checkpoint
    first.train(until=7)
    collected = episodes_on_disk(first.agpd)
    resumed = start(checkpoint)
    assert resumed.agpd.progress.step == 4 and resumed.agpd.progress.rounds == 2
    resumed.train(until=7)
    assert len(resumed.agpd.reports) == 2 and episodes_on_disk(resumed.agpd).keys() == collected.keys()
    resumed.train(until=9)
    assert len(resumed.agpd.reports) == 3


def test_a_run_that_was_moved_finds_its_episodes(start, tmp_path):
    first = start().train(until=4).save()
    (tmp_path / "run").rename(tmp_path / "moved")
    moved = tmp_path / "moved" / first.checkpoint.relative_to(tmp_path / "run")
    resumed = start(moved)
    assert resumed.agpd.journal.root == tmp_path / "moved" / "agpd" and len(resumed.agpd.reports) == 1


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
