"""Rounds on Push-T with a toy teacher and student: resuming, and what diagnostics must not change."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.envs.configs import PushtEnv
from toy_policies import STATE, NoisyTeacher, alignment

from lerobot_agpd.collect.config import (
    CollectConfig,
    DiagnosticsConfig,
    MixingConfig,
    RollinConfig,
    VariationConfig,
)
from lerobot_agpd.collect.deciders.pair import Pair
from lerobot_agpd.collect.round import RoundRunner
from lerobot_agpd.collect.strategies import make_decider
from lerobot_agpd.guidance.config import GuidanceConfig, TeacherConfig
from lerobot_agpd.replay.episode import EpisodeRecord
from lerobot_agpd.replay.store import ReplayStore

pytest.importorskip("gym_pusht")

LENGTH, SCALE, EPISODES = 8, 0.5, 5
FEATURES = {
    STATE: {"dtype": "float32", "shape": (2,), "names": None},
    "observation.environment_state": {"dtype": "float32", "shape": (16,), "names": None},
    "action": {"dtype": "float32", "shape": (2,), "names": None},
}


class Pusher(NoisyTeacher):
    """Wanders around the middle of the table."""

    def __init__(self):
        super().__init__(spread=20.0, action_dim=2)

    def to_units(self, actions_raw):
        return (actions_raw - 256.0) / 2.0

    def to_raw(self, actions):
        return actions * 2.0 + 256.0


def stay(history):
    """The student: four steps at the current position, raw actions over 5."""
    return history[STATE][:, -1:].expand(-1, 4, -1) / 5.0


@pytest.fixture(scope="module")
def demonstrations(tmp_path_factory):
    """A short dataset with Push-T's features."""
    dataset = LeRobotDataset.create(
        "local/pusht", fps=10, features=FEATURES, root=tmp_path_factory.mktemp("data") / "pusht"
    )
    rng = np.random.default_rng(0)
    for _ in range(20):
        frame = {key: rng.uniform(0, 512, ft["shape"]).astype(np.float32) for key, ft in FEATURES.items()}
        dataset.add_frame({**frame, "task": "push"})
    dataset.save_episode()
    dataset.finalize()
    return LeRobotDataset("local/pusht", root=dataset.root).meta


class Rounds:
    """A runner, its store and the configuration they share."""

    def __init__(self, root, demonstrations, **collect):
        self.config = SimpleNamespace(
            collect=CollectConfig(episodes=EPISODES, n_envs=2, unguided_fraction=0.4, **collect),
            guidance=GuidanceConfig(),
            teacher=TeacherConfig(),
            device="cpu",
            input_features={STATE: PolicyFeature(FeatureType.STATE, (2,))},
        )
        env = PushtEnv(obs_type="environment_state_agent_pos", episode_length=LENGTH)
        self.store = ReplayStore(root)
        self.runner = RoundRunner(self.store, env, self.config, demonstrations, seed=7, rank=0, n_ranks=1)
        self.runner.filter = SimpleNamespace(judge=keep)

    def collect(self, number=0):
        teacher = Pusher()
        pair = Pair(teacher, stay, alignment(teacher))
        decider = make_decider(self.config, pair, self.runner.noise(number))
        records, seconds = self.runner.collect(number, SCALE, decider)
        return decider, records, seconds

    def arrays(self, number=0):
        return [episode.actions for episode in self.store.spool(number, 0).kept()]


def keep(episode) -> EpisodeRecord:
    """Keeps everything but what the student finished alone."""
    return EpisodeRecord(
        number=episode.ticket.number,
        seed=episode.ticket.seed,
        scale=episode.ticket.scale,
        length=len(episode),
        max_reward=episode.max_reward,
        success=episode.success,
        passed=True,
        trivial=False,
        kept=not episode.student_alone,
        j=episode.j,
        shift=episode.shift,
        student_steps=episode.student_steps,
        student_alone=episode.student_alone,
    )


STRATEGIES = {
    "replay": {},
    "guided": {"variation": VariationConfig(quantile=0.3, scale_spread=2.0)},
    "mixing": {"mixing": MixingConfig(form="switch")},
    "rollin": {"rollin": RollinConfig(max_fraction=1.0)},
}


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_diagnostics_do_not_change_the_episodes(tmp_path, demonstrations, strategy):
    """Bit-identical with and without, over two rounds; only one of them has numbers."""
    options = {"strategy": strategy, **STRATEGIES[strategy]}
    watched = Rounds(
        tmp_path / "watched",
        demonstrations,
        diagnostics=DiagnosticsConfig(observations=3, samples=2),
        **options,
    )
    plain = Rounds(
        tmp_path / "plain", demonstrations, diagnostics=DiagnosticsConfig(observations=0), **options
    )
    for number in range(2):
        before = torch.get_rng_state()
        decider, records, seconds = watched.collect(number)
        found = watched.runner.diagnose(number, SCALE, decider)
        assert torch.equal(before, torch.get_rng_state())
        plain_decider, plain_records, plain_seconds = plain.collect(number)
        assert plain.runner.diagnose(number, SCALE, plain_decider) is None
        assert repr(records) == repr(plain_records)
        for ours, theirs in zip(watched.arrays(number), plain.arrays(number), strict=True):
            np.testing.assert_array_equal(ours, theirs)
        for taken in (seconds, plain_seconds):
            assert (
                {"teacher", "environment", "writing"}
                <= set(taken)
                <= {
                    "teacher",
                    "student",
                    "environment",
                    "writing",
                }
            )
        assert found["actions"]["observations"] == 3
        assert (found["actions"]["rms_to_teacher"] == 0) == (strategy == "replay")
        assert found["states"]["dim"] == 18 and found["seconds"] > 0
        report = watched.runner.report(number, SCALE, records, seconds, found)
        watched.runner.finish(number, report)
        plain.runner.finish(number, plain.runner.report(number, SCALE, plain_records, plain_seconds))
        assert json.loads(json.dumps(watched.store.rounds()[number].report)) == json.loads(json.dumps(report))
        assert plain.store.rounds()[number].report["diagnostics"] is None


def test_half_a_round_goes_on_with_the_same_tickets(tmp_path, demonstrations):
    options = {
        "strategy": "rollin",
        "rollin": RollinConfig(max_fraction=0.9),
        "variation": VariationConfig(scale_spread=3.0),
    }
    whole = Rounds(tmp_path / "whole", demonstrations, **options)
    _, expected, _ = whole.collect()
    torn = Rounds(tmp_path / "torn", demonstrations, **options)
    tickets = torn.runner.tickets(0, SCALE)
    assert tickets == whole.runner.tickets(0, SCALE)
    assert len({ticket.student_share for ticket in tickets}) == EPISODES

    pair = Pair(Pusher(), stay, alignment(Pusher()))
    decider = make_decider(torn.config, pair, torn.runner.noise(0))
    spool = torn.store.spool(0, 0)
    torn.runner._roll_out(0, tickets[:2], EPISODES, decider, spool)  # then the process dies
    first = {number: record.to_json() for number, record in spool.records.items()}
    _, records, _ = torn.collect()

    assert [record.number for record in records] == list(range(EPISODES))
    for ours, theirs in zip(records, expected, strict=True):
        assert (ours.seed, ours.scale, ours.student_steps) == (
            theirs.seed,
            theirs.scale,
            theirs.student_steps,
        )
    assert {number: records[number].to_json() for number in first} == first


def test_a_failed_upload_does_not_end_the_training(tmp_path, demonstrations, caplog):
    """LeRobot writes the last checkpoint after the last update."""
    rounds = Rounds(tmp_path, demonstrations, push_to_hub=True, repo_id="nobody/nothing")
    _, records, seconds = rounds.collect()
    rounds.runner.finish(0, rounds.runner.report(0, SCALE, records, seconds))
    rounds.runner.merge()  # offline, or without a token
    assert "could not be merged or uploaded" in caplog.text
    again = f"lerobot-agpd-merge --root={tmp_path} --repo_id=nobody/nothing --push_to_hub=true"
    assert again in caplog.text
    assert len(rounds.store.rounds()) == 1


def test_rollin_records_the_teachers_part(tmp_path, demonstrations):
    rounds = Rounds(tmp_path, demonstrations, strategy="rollin", rollin=RollinConfig(max_fraction=0.7))
    _, records, _ = rounds.collect()
    assert any(record.student_steps for record in records)
    for record, episode in zip(records, rounds.store.spool(0, 0).kept(), strict=True):
        assert record.student_steps + record.length == LENGTH
        assert len(episode) == record.length and episode.student_steps == record.student_steps


def test_an_environment_that_does_not_fit_is_refused_before_the_first_rollout(tmp_path):
    """Not after a round of them, when the dataset is written."""
    other = {**FEATURES, "observation.environment_state": {"dtype": "float32", "shape": (3,), "names": None}}
    dataset = LeRobotDataset.create("local/other", fps=10, features=other, root=tmp_path / "other")
    rounds = Rounds(tmp_path / "rounds", dataset.meta, strategy="guided")
    with pytest.raises(ValueError, match=r"'observation.environment_state' with shape \(16,\).*\(3,\)"):
        rounds.collect()
    assert not rounds.store.spool(0, 0).records


def test_spools_of_older_rounds_are_read(tmp_path, demonstrations):
    """Their records know nothing of the student's part and of retries."""
    rounds = Rounds(tmp_path, demonstrations, strategy="guided")
    rounds.collect()
    spool = rounds.store.spool(0, 0)
    lines = [json.loads(line) for line in spool.log.read_text().splitlines()]
    new = ("student_steps", "student_alone", "retry")
    older = [{k: v for k, v in line.items() if k not in new} for line in lines]
    spool.log.write_text("".join(json.dumps(line) + "\n" for line in older))
    _, records, _ = rounds.collect()
    assert len(records) == EPISODES and not any(record.student_alone for record in records)


@pytest.mark.parametrize("strategy", ["replay", "guided"])
def test_the_next_round_starts_again_where_the_last_one_failed(tmp_path, demonstrations, strategy):
    rounds = Rounds(tmp_path, demonstrations, strategy=strategy, retry_fraction=0.5)
    scale = SCALE if strategy == "guided" else 0.0
    fresh = [ticket.seed for ticket in rounds.runner.tickets(0, scale)]
    failing = {fresh[0], fresh[2], fresh[3]}

    def judge(episode):
        record = keep(episode)
        passed = record.seed not in failing
        return replace(record, passed=passed, kept=passed, retry=episode.ticket.retry)

    rounds.runner.filter = SimpleNamespace(judge=judge)
    _, records, seconds = rounds.collect(0)
    assert not any(record.retry for record in records)
    rounds.runner.finish(0, rounds.runner.report(0, SCALE, records, seconds))

    tickets = rounds.runner.tickets(1, scale)
    retried = [ticket for ticket in tickets if ticket.retry]
    assert len(retried) == EPISODES // 2 and {ticket.seed for ticket in retried} < failing
    failing.clear()
    _, records, seconds = rounds.collect(1)
    report = rounds.runner.report(1, SCALE, records, seconds)
    assert [record.seed for record in records if record.retry] == [ticket.seed for ticket in retried]
    assert report["retried"]["successful"] == EPISODES // 2
    rounds.runner.finish(1, report)
    (left,) = [ticket.seed for ticket in rounds.runner.tickets(2, scale) if ticket.retry]
    assert left not in {ticket.seed for ticket in retried}
