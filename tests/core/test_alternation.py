"""The alternation: warm-up, rounds, T grows, the scale adapts; then resumed, interrupted, finished."""

import numpy as np
import pytest
import torch
from lerobot.policies import make_pre_post_processors
from point_environment import EPISODE_LENGTH, PointEnv, PointTeacher, demonstrate
from small_dataset import create_dataset

from lerobot_agpd import agpd as algorithm, build as builders
from lerobot_agpd.config import AdversaryConfig, CollectConfig, GuidanceConfig, TeacherConfig
from lerobot_agpd.guidance.representation import StateRepresentation
from lerobot_agpd.policies.agpd.modeling_agpd import AGPDPolicy
from lerobot_agpd.replay.export import MERGED, merge
from lerobot_agpd.replay.replay import FRAME_INDEX
from lerobot_agpd.rollout.report import success_rate
from lerobot_agpd.run import RunInfo

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
    run = start(collect={"diagnostics": True})
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
    eval_index = agpd.eval_batch(run.batch())[FRAME_INDEX]
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
    dataset = merge(agpd.journal.root)
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


def test_rounds_repeat_bit_for_bit(start, tmp_path):
    first, second = (start(output_dir=tmp_path / name).train(until=4).agpd for name in ("a", "b"))
    ours, theirs = (list(episodes_on_disk(agpd).values()) for agpd in (first, second))
    assert len(ours) == len(theirs) > 0
    for mine, yours in zip(ours, theirs, strict=True):
        assert mine.tobytes() == yours.tobytes()


def test_a_fixed_scale_stays(start):
    run = start(guidance={"adaptive": False}, steps=7).train(until=6)
    assert [report.strength for report in run.agpd.reports] == [SCALE, SCALE]


@pytest.mark.parametrize("strategy", ["teacher", "mixing", "rollin"])
def test_every_strategy_fills_the_replay(start, strategy):
    run = start(collect={"strategy": strategy}, steps=4).train(until=4)
    (report,) = run.agpd.reports
    strengths = {record.strength for record in run.records(0)}
    assert strengths == {"teacher": {0.0}, "mixing": {0.0, 0.3}, "rollin": {0.0, SCALE}}[strategy]
    assert report.kept_frames == run.agpd.replay.n_collected_frames > 0
    assert (report.next_scale != SCALE) == (strategy == "rollin"), "guidance alone adapts"


def test_a_learned_discrepancy_guides_too(start, point_demonstrations, agpd_config, monkeypatch):
    monkeypatch.setattr(builders, "_check_steps", lambda *_: None)
    run = start(steps=4)
    run.policy.representation = StateRepresentation(5, 2, n_steps=2)
    run.train(until=4)
    (report,) = run.agpd.reports
    assert report.mean_guidance_shift > 0 and run.logs[-1]["representation_loss"] > 0


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
    resumed.train(until=STEPS)
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
