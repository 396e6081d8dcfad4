"""The alternation: warm-up, rounds, T grows, the scale adapts; several processes, gradient accumulation."""

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from point_environment import EPISODE_LENGTH, Point, PointEnv
from toy_run import EPISODES, ROUND_STEPS, SCALE, STEPS, TEACHER_ONLY, episodes_on_disk

from lerobot_agpd import agpd as algorithm
from lerobot_agpd.agpd import make_strategy
from lerobot_agpd.config import MixingConfig
from lerobot_agpd.guidance.representation import StateRepresentation
from lerobot_agpd.replay.export import MERGED
from lerobot_agpd.replay.normalization import Normalizer
from lerobot_agpd.replay.replay import FRAME_INDEX
from lerobot_agpd.rollout.collector import Collector
from lerobot_agpd.rollout.report import success_rate
from lerobot_agpd.student import StudentSampler

# ---- a whole run ----


def test_the_alternation(start, toy_teacher):
    run = start()
    agpd, n_demonstrated = run.agpd, run.agpd.replay.n_demonstration_frames

    run.train(until=2)
    assert agpd.reports == [] and agpd.journal.records(0) == [], "the warm-up collects nothing"
    assert run.logs[-1]["collected_fraction"] == 0
    assert toy_teacher.calls == [], "and the adversary has yet to start"

    run.train(until=3)
    records, (report,) = run.records(0), agpd.reports
    assert [record.number for record in records] == list(range(EPISODES))
    assert sorted(record.strength for record in records) == [0.0] * TEACHER_ONLY + [SCALE] * 4
    assert {record.length for record in records if not record.strength} == {EPISODE_LENGTH}
    assert all(np.isfinite(record.guidance_shift) == (record.strength > 0) for record in records)
    assert report.step == 3 and report.strength == SCALE and report.total.generated == EPISODES
    assert success_rate([report.teacher_only]) == 1

    kept_frames = sum(record.length for record in records if record.kept)
    assert agpd.replay.n_collected_frames == kept_frames == report.kept_frames > 0
    batches = [agpd.train_batch(run.batch()) for _ in range(2)]
    frame_index = batches[0][FRAME_INDEX]
    assert (frame_index < n_demonstrated).any() and (frame_index >= n_demonstrated).any()
    assert torch.equal(frame_index, batches[1][FRAME_INDEX]), "a step's frames follow from its number"
    eval_index = agpd.replay.eval_batch(run.batch())[FRAME_INDEX]
    assert (eval_index < n_demonstrated).all(), "a held-out loss is that of demonstrations"

    run.train(until=STEPS)
    assert [report.step for report in agpd.reports] == ROUND_STEPS
    strengths = [report.strength for report in agpd.reports]
    assert strengths[1:] == [report.next_strength for report in agpd.reports[:-1]]
    guided = success_rate([report.strategy])
    assert strengths[1] == (2 * SCALE if guided >= 0.95 else SCALE / 2)
    last = run.logs[-1]
    assert last["rounds"] == 3 and last["episodes_generated"] == 3 * EPISODES
    assert last["strength"] == strengths[-1] and 0 < last["discriminator_accuracy"] <= 1
    assert 0 < last["collected_fraction"] < 1 and np.isfinite(last["loss"])

    merged = agpd.journal.root / MERGED
    assert merged.is_dir(), "the last step merges all kept episodes"
    dataset = LeRobotDataset("local/merged", root=merged)
    assert dataset.num_frames == agpd.replay.n_collected_frames
    assert set(dataset.features) >= {"observation.state", "action", "agpd.round", "agpd.strength"}
    n_kept = sum(report.total.kept for report in agpd.reports)
    assert dataset.num_episodes == n_kept and dataset[0]["task"] == "reach the origin"


def test_a_round_leaves_random_numbers_and_mode_as_they_were(start):
    run = start().train(until=2)
    for mode in (True, False):
        run.policy.train(mode)
        before = torch.get_rng_state()
        run.agpd.grow()
        assert torch.equal(torch.get_rng_state(), before) and run.policy.training is mode


@pytest.mark.parametrize("strategy", ["teacher", "guided", "mixing", "rollin"])
def test_rounds_repeat_bit_for_bit_and_diagnostics_change_nothing(start, tmp_path, strategy):
    collect = {"strategy": strategy, "mixing": MixingConfig(form="switch"), "episodes": 3}
    first, second = (
        start(output_dir=tmp_path / str(measured), collect={**collect, "diagnostics": measured}, steps=4)
        .train(until=4)
        .agpd
        for measured in (True, False)
    )
    assert [repr(r) for r in first.journal.records(0)] == [repr(r) for r in second.journal.records(0)]
    ours, theirs = (list(episodes_on_disk(agpd).values()) for agpd in (first, second))
    assert len(ours) == len(theirs) > 0
    assert all(mine.tobytes() == yours.tobytes() for mine, yours in zip(ours, theirs, strict=True))
    measured = first.reports[0].diagnostics
    assert (measured.actions["rms_to_teacher"] == 0) == (strategy == "teacher")
    assert measured.states["dim"] == 5 and second.reports[0].diagnostics is None


def test_a_fixed_scale_stays(start):
    run = start(guidance={"adaptive": False}, steps=7).train(until=6)
    assert [report.strength for report in run.agpd.reports] == [SCALE, SCALE]


@pytest.mark.parametrize(
    ("strategy", "strengths"),
    [("teacher", {0.0}), ("mixing", {0.0, 0.3}), ("rollin", {0.0, SCALE})],
)
def test_every_strategy_fills_the_replay(start, strategy, strengths):
    run = start(collect={"strategy": strategy}, steps=4).train(until=3)
    (report,) = run.agpd.reports
    assert {record.strength for record in run.records(0)} == strengths
    assert report.kept_frames == run.agpd.replay.n_collected_frames > 0
    assert (report.next_strength != SCALE) == (strategy == "rollin"), "guidance alone adapts"


def test_a_learned_discrepancy_guides_too(start):
    run = start(steps=4)
    run.policy.representation = StateRepresentation(5, 2, n_steps=2)
    run.train(until=4)
    (report,) = run.agpd.reports
    assert report.mean_guidance_shift > 0 and run.logs[-1]["representation_loss"] > 0


def test_an_environment_that_is_solved_from_the_start_is_not_the_teachers_fault(start, monkeypatch, caplog):
    reset = Point.reset

    def reset_at_the_goal(self, **options):
        _, info = reset(self, **options)
        self.position = self.position * 0.1
        return self.observation(), info

    monkeypatch.setattr(Point, "reset", reset_at_the_goal)
    run = start().train(until=3)
    assert run.agpd.reports[0].total.solved_at_start == EPISODES
    (warning,) = [r.getMessage() for r in caplog.records if "kept no episode" in r.getMessage()]
    assert f"all {EPISODES} were solved at the start" in warning and "weak" not in warning
    assert run.agpd.strength == SCALE


def test_an_environment_that_never_succeeds_leaves_the_guidance_as_it_is(start, monkeypatch, caplog):
    monkeypatch.setattr("point_environment.REACHED", -1.0)
    run = start().train(until=6)
    assert [report.total.successful for report in run.agpd.reports] == [0, 0] and run.agpd.strength == SCALE
    assert "the teacher is too weak or the success filter too strict" in caplog.text


def test_the_next_round_starts_again_where_the_last_one_failed(start, monkeypatch):
    failing, classify = set(), algorithm.classify

    def failing_there(episode, config):
        record = classify(episode, config)
        failed = record.number in (0, 2, 3) and not record.retry
        if failed:
            failing.add(record.seed)
        return replace(record, success=not failed, kept=not failed)

    monkeypatch.setattr(algorithm, "classify", failing_there)
    run = start(collect={"retry_fraction": 0.5}).train(until=3)
    assert not any(record.retry for record in run.records(0))
    first = set(failing)
    run.train(until=6)
    retried = [record.seed for record in run.records(1) if record.retry]
    assert len(retried) == EPISODES // 2 and set(retried) == first
    assert run.agpd.reports[1].retried.successful == EPISODES // 2


def test_what_an_environment_delivers_is_checked_against_the_demonstrations(start):
    """Not only what its configuration declares."""
    with pytest.raises(ValueError, match=r"'observation.state' with shape \(7,\).*\(2,\)"):
        start().agpd.collector.check({"observation.state": np.zeros(7)})


def test_a_failed_upload_does_not_end_the_training(start, caplog):
    """LeRobot writes the last checkpoint after the last update."""
    start(collect={"push_to_hub": True, "repo_id": "nobody/nothing"}, steps=4).train(until=4)
    assert "lerobot-agpd-merge --root=" in caplog.text
    assert "--repo_id=nobody/nothing --push_to_hub=true" in caplog.text


# ---- several processes ----


class Process:
    """One of several processes that share a round, in turns in this one."""

    def __init__(self, agpd, demonstrations, rank, n_ranks):
        self.agpd, self.rank, config = agpd, rank, agpd.config
        self.collector = Collector(
            config, PointEnv(), demonstrations.meta, agpd.journal, lambda _: None, 7, rank, n_ranks
        )
        self.sampler = StudentSampler(agpd.student, Normalizer(config, demonstrations.meta.stats))

    def collect(self, done, at_most=EPISODES):
        """Roll out this process's part of what is not done, and append up to so many episodes."""
        strategy = make_strategy(
            self.agpd.config, self.sampler.pair_with(self.agpd.teacher), self.collector.noise(0)
        )
        for episode in islice(self.collector.roll_out(0, SCALE, strategy, done), at_most):
            record = algorithm.classify(episode, self.agpd.config.collect)
            self.agpd.journal.append(0, self.rank, episode, record)


def test_processes_collect_parts_of_a_round(start, point_demonstrations):
    """Together they collect the episodes of one process, each with noise of its own."""
    agpd = start().agpd
    processes = [Process(agpd, point_demonstrations, rank, 2) for rank in (0, 1)]
    for process in processes:
        process.collect(done=())
    records = agpd.journal.records(0)
    specs = Process(agpd, point_demonstrations, 0, 1).collector.specs(0, SCALE)
    assert [(r.number, r.seed, r.strength) for r in records] == [
        (s.number, s.seed, s.strength) for s in specs
    ]
    assert len({record.seed for record in records}) == EPISODES
    assert sum(record.strength == 0 for record in records) == TEACHER_ONLY
    noise = [torch.randn(3, generator=process.collector.noise(0)) for process in processes]
    assert not torch.equal(*noise)


@pytest.mark.parametrize(("before", "after"), [(2, 1), (1, 2), (3, 2), (2, 2)])
@pytest.mark.parametrize("at_most", [0, 1, 2])
def test_a_round_goes_on_with_another_number_of_processes(
    start, point_demonstrations, before, after, at_most
):
    """No episode is lost, collected twice or left out; what is there stays as it is."""
    agpd = start().agpd
    for rank in range(before):
        Process(agpd, point_demonstrations, rank, before).collect((), at_most)
    first, frames = agpd.journal.records(0), episodes_on_disk(agpd)
    done = {record.number for record in first}
    assert len(done) == before * at_most
    for rank in range(after):
        Process(agpd, point_demonstrations, rank, after).collect(done)
    records = agpd.journal.records(0)
    assert [record.number for record in records] == list(range(EPISODES))
    assert [repr(record) for record in records if record.number in done] == [repr(r) for r in first]
    assert all(episodes_on_disk(agpd)[path].tobytes() == frame.tobytes() for path, frame in frames.items())
    kept = [record.number for record in records if record.kept]
    assert [episode.record.number for episode in agpd.journal.kept(0)] == kept


# ---- gradient accumulation ----


def test_rounds_are_counted_in_lerobots_steps(start):
    """With two steps per update a round is due at 3 and 6: after the updates at 4 and 6, and none at 8, the last."""
    run = start(steps=9, steps_per_update=2).train(until=4)
    indices = [run.agpd.train_batch(run.batch())[FRAME_INDEX] for _ in range(2)]
    assert not torch.equal(*indices), "the micro-batches of an update are drawn apart"
    assert not (run.agpd.journal.root / MERGED).exists()
    run.train(until=8)
    assert [report.step for report in run.agpd.reports] == [4, 6]
    assert (run.agpd.journal.root / MERGED).is_dir()


def test_a_run_of_unknown_length_is_never_at_its_end(start):
    run = start(steps=None).train(until=4)
    assert not run.agpd.after_update() and not (run.agpd.journal.root / MERGED).exists()
