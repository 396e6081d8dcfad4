"""The alternation: warm-up, rounds, T grows, the scale adapts; then resumed, interrupted, finished."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies import make_pre_post_processors
from point_environment import EPISODE_LENGTH, Point, PointEnv, PointTeacher, demonstrate
from small_dataset import create_dataset

from lerobot_agpd import agpd as algorithm, build as builders
from lerobot_agpd.agpd import make_strategy
from lerobot_agpd.config import AdversaryConfig, CollectConfig, GuidanceConfig, MixingConfig, TeacherConfig
from lerobot_agpd.guidance.representation import StateRepresentation
from lerobot_agpd.policies.agpd.modeling_agpd import AGPDPolicy
from lerobot_agpd.replay.export import MERGED
from lerobot_agpd.replay.normalization import Normalizer
from lerobot_agpd.replay.replay import FRAME_INDEX
from lerobot_agpd.rollout.collector import Collector
from lerobot_agpd.rollout.report import success_rate
from lerobot_agpd.run import RunInfo
from lerobot_agpd.student import StudentSampler

STEPS, EPISODES, TEACHER_ONLY, SCALE = 10, 6, 2, 0.25
ROUND_STEPS = [3, 6, 9]


@pytest.fixture(scope="module")
def point_demonstrations(tmp_path_factory):
    return demonstrate(create_dataset(tmp_path_factory.mktemp("data") / "point"), 3)


@pytest.fixture(autouse=True)
def toy_teacher(monkeypatch):
    """The teacher that every run loads."""
    teacher = PointTeacher()
    monkeypatch.setattr(builders, "load_teacher", lambda config, device: teacher)
    return teacher


class Run:
    """A run of a few steps through the hooks that LeRobot's training loop calls."""

    def __init__(self, policy: AGPDPolicy, dataset):
        self.policy, self.dataset, self.logs = policy.train(), dataset, []
        self.optimizer = torch.optim.AdamW(policy.get_optim_params(), lr=1e-4)
        self.processors = make_pre_post_processors(policy.config, dataset_stats=dataset.meta.stats)

    @property
    def agpd(self):
        return self.policy.agpd

    def batch(self):
        frames = torch.utils.data.default_collate([self.dataset[n] for n in range(0, len(self.dataset), 2)])
        return self.processors[0](frames)

    def train(self, until: int) -> "Run":
        """Train until so many steps are done."""
        while self.agpd.progress.step < until:
            self.policy.train()
            for _ in range(self.agpd.run.steps_per_update):
                loss, log = self.policy.forward(self.batch())
                loss.backward()
                self.logs.append({"loss": loss.item(), **log})
            self.optimizer.step()
            self.optimizer.zero_grad()
            self.policy.update()
        return self

    def save(self) -> "Run":
        """Save a checkpoint where LeRobot would."""
        self.policy.save_pretrained(self.checkpoint)
        for processor in self.processors:
            processor.save_pretrained(self.checkpoint)
        return self

    @property
    def checkpoint(self):
        step = f"{self.agpd.progress.step:06d}"
        return self.agpd.run.output_dir / "checkpoints" / step / "pretrained_model"

    def records(self, round_number):
        return self.agpd.journal.records(round_number)


@pytest.fixture
def start(agpd_config, point_demonstrations, tmp_path):
    """Starts a run, or continues one from its checkpoint; `facts` are those of the run."""

    def start(checkpoint=None, collect=None, guidance=None, **facts) -> Run:
        torch.manual_seed(0)
        config = agpd_config(
            teacher=TeacherConfig(path="a/toy"),
            guidance=GuidanceConfig(**{"scale": SCALE, **(guidance or {})}),
            adversary=AdversaryConfig(start=2),
            collect=CollectConfig(
                **{
                    "warmup": ROUND_STEPS[0],
                    "every": 3,
                    "episodes": EPISODES,
                    "n_envs": 3,
                    "diagnostics": False,
                    "teacher_only_fraction": TEACHER_ONLY / EPISODES,
                    **(collect or {}),
                }
            ),
        )
        run = RunInfo(
            **{"output_dir": tmp_path / "run", "env": PointEnv(), "steps": STEPS, **facts},
            resume=checkpoint is not None,
        )
        meta = point_demonstrations.meta
        options = {"dataset_stats": meta.stats, "dataset_meta": meta, "run": run}
        if checkpoint is None:
            return Run(AGPDPolicy(config, **options), point_demonstrations)
        config.pretrained_path = checkpoint
        policy = AGPDPolicy.from_pretrained(checkpoint, config=config, **options)
        return Run(policy, point_demonstrations)

    return start


def episodes_on_disk(agpd) -> dict[str, np.ndarray]:
    return {str(path): np.load(path) for path in sorted(agpd.journal.root.rglob("*.npy"))}


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
    assert strengths[1:] == [report.next_scale for report in agpd.reports[:-1]]
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
        run.agpd.collect_round()
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
    assert (report.next_scale != SCALE) == (strategy == "rollin"), "guidance alone adapts"


def test_a_learned_discrepancy_guides_too(start, point_demonstrations, agpd_config, monkeypatch):
    monkeypatch.setattr(builders, "_check_steps", lambda *_: None)
    run = start(steps=4)
    run.policy.representation = StateRepresentation(5, 2, n_steps=2)
    run.train(until=4)
    (report,) = run.agpd.reports
    assert report.mean_guidance_shift > 0 and run.logs[-1]["representation_loss"] > 0


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


# ---- numbers that are not finite ----


@pytest.fixture
def break_environment(monkeypatch):
    """Makes the environment deliver NaN in some of its episodes, counted from 0, from the second step on."""

    def break_it(what, episodes):
        counter, reset, step = iter(range(10**6)), Point.reset, Point.step

        def counted_reset(self, **options):
            self.broken = next(counter) in episodes
            self.n_steps = 0
            return reset(self, **options)

        def broken_step(self, action):
            observation, reward, *rest = step(self, action)
            self.n_steps += 1
            if self.broken and self.n_steps == 2:
                if what == "reward":
                    reward = float("nan")
                else:
                    observation[what] = np.full_like(observation[what], np.nan)
            return observation, reward, *rest

        monkeypatch.setattr(Point, "reset", counted_reset)
        monkeypatch.setattr(Point, "step", broken_step)

    return break_it


BROKEN = {
    "agent_pos": "'observation.state' at step 2",
    "environment_state": "'observation.environment_state' at step 2",
    "reward": "'next.reward' at step 1",
}


@pytest.mark.parametrize("what", BROKEN)
def test_one_nan_from_the_environment_costs_its_episode_and_no_more(start, break_environment, caplog, what):
    """It is not kept although it succeeds, is counted, and the run goes on, also when resumed."""
    break_environment(what, episodes={1})
    run = start().train(until=4).save()
    (report,) = run.agpd.reports
    (record,) = [record for record in run.records(0) if record.invalid]
    assert record.invalid == BROKEN[what] and not record.kept and not record.success
    assert report.total.invalid == 1 and report.total.generated == EPISODES and report.total.kept > 0
    (warning,) = [r.getMessage() for r in caplog.records if "not finite" in r.getMessage()]
    assert BROKEN[what] in warning and "1 of 6" in warning
    assert all(np.isfinite(columns).all() for columns in run.agpd.replay.table.columns.values())
    assert np.isfinite(run.logs[-1]["loss"])
    assert all(torch.isfinite(value).all() for value in run.policy.state_dict().values())
    resumed = start(run.checkpoint)
    assert resumed.agpd.reports == run.agpd.reports
    assert resumed.train(until=7).agpd.reports[1].total.invalid == 0


@pytest.mark.parametrize("what", BROKEN)
def test_a_round_of_mostly_invalid_episodes_stops_the_run(start, break_environment, what):
    break_environment(what, episodes=set(range(100)) - {1})
    run = start().train(until=2).save()
    with pytest.raises(
        FloatingPointError, match=rf"of 6 episodes.*{BROKEN[what]}.*--env.*round-00000.*--resume"
    ):
        run.train(until=3)
    assert run.agpd.journal.reports() == []


# ---- several processes ----


def test_processes_collect_parts_of_a_round(start, point_demonstrations):
    """Both parts are those of one round, from different starts with different noise."""
    agpd = start().agpd
    collectors = [
        Collector(
            agpd.config, PointEnv(), point_demonstrations.meta, agpd.journal, lambda _: None, 7, rank, 2
        )
        for rank in (0, 1)
    ]
    for rank, collector in enumerate(collectors):
        sampler = StudentSampler(agpd.student, Normalizer(agpd.config, point_demonstrations.meta.stats))
        strategy = make_strategy(agpd.config, sampler.pair_with(agpd.teacher), collector.noise(0))
        for episode in collector.roll_out(0, SCALE, strategy, done=()):
            agpd.journal.append(0, rank, episode, algorithm.classify(episode, agpd.config.collect))
    parts = [agpd.journal.records(0, rank) for rank in (0, 1)]
    assert [len(part) for part in parts] == [EPISODES // 2] * 2
    together = agpd.journal.records(0)
    assert [repr(record) for record in together] == [repr(record) for part in parts for record in part]
    assert len({record.seed for record in together}) == EPISODES
    assert sum(record.strength == 0 for record in together) == TEACHER_ONLY
    noise = [torch.randn(3, generator=collector.noise(0)) for collector in collectors]
    assert not torch.equal(*noise)


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


# ---- resume ----


def test_a_resumed_run_goes_on_where_its_checkpoint_was(start, tmp_path):
    first = start().train(until=4).save()
    resumed = start(first.checkpoint)
    assert resumed.agpd.progress.step == 4 and len(resumed.agpd.reports) == 1
    assert resumed.agpd.replay.n_collected_frames == first.agpd.replay.n_collected_frames
    assert resumed.agpd.scale == first.agpd.scale != SCALE
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
