"""Rollouts against a deterministic environment simulated by hand."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from lerobot_agpd.replay.episode import EpisodeSpec
from lerobot_agpd.rollout.rollout import Rollouts, step_limit
from lerobot_agpd.rollout.strategies import ChunkBatch
from lerobot_agpd.stopwatch import Stopwatch

NAME = "lerobot_agpd_tests/Countdown-v0"
N_STEPS = 2  # executed steps per decision


class Countdown(gym.Env):
    """Sums its actions; a seed of length * 100 + anything gives `length` steps, an odd one succeeds at the last.

    Without a seed (autoreset) the episode is one that no spec describes.
    """

    observation_space = gym.spaces.Dict(
        agent_pos=gym.spaces.Box(-np.inf, np.inf, (2,), np.float64),
        environment_state=gym.spaces.Box(-np.inf, np.inf, (1,), np.float64),
    )
    action_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float32)
    reports_success = True
    task_description = "count down"

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.seed, self.clock, self.total = (-700 if seed is None else seed), 0, 0.0
        return self._observation(), {}

    def _observation(self):
        position = np.array([self.seed, self.clock], dtype=np.float64)
        return {"agent_pos": position, "environment_state": np.array([self.total])}

    def step(self, action):
        self.clock += 1
        self.total += float(action[0])
        done = self.clock >= abs(self.seed) // 100
        info = {"is_success": done and self.seed % 2 == 1} if self.reports_success else {}
        return self._observation(), 10 * self.total, done, False, info


class Silent(Countdown):
    reports_success = False


@pytest.fixture(scope="module", autouse=True)
def registered():
    gym.register(NAME, entry_point=Countdown)
    yield
    gym.registry.pop(NAME)


class Counting:
    """A strategy that executes seed + (previous clock, clock) + 0, 1, ...: it shows what its decision has seen."""

    n_obs_steps = 2

    def __init__(self, broken_seed=None):
        self.broken_seed = broken_seed
        self.stopwatch = Stopwatch()
        self.generator = torch.Generator()

    def act(self, history, strength, student_acts=None):
        assert history["task"] == ["count down"] * len(strength) and not torch.is_grad_enabled()
        state = history["observation.state"]  # (B, 2, 2)
        assert state.shape[1:] == (2, 2) and history["observation.environment_state"].shape[1:] == (2, 1)
        first = state[:, -1, 0] + 0.25 * state[:, 0, 1] + 0.5 * state[:, 1, 1]
        actions = first[:, None, None] + torch.arange(N_STEPS).view(1, -1, 1)
        if self.broken_seed is not None:
            actions[state[:, -1, 0] == self.broken_seed, -1] = float("nan")
        clock = state[:, 1, 1]
        return ChunkBatch(actions, clock, torch.where(strength > 0, 2 * clock, torch.nan))


class CountingEnv(SyncVectorEnv):
    n_steps = n_resets = 0

    def step(self, actions):
        self.n_steps += 1
        return super().step(actions)

    def reset(self, **options):
        self.n_resets += 1
        return super().reset(**options)


def rollouts(n_envs=1, strategy=None, make=lambda: gym.make(NAME), **options) -> Rollouts:
    envs = CountingEnv([make] * n_envs, autoreset_mode=AutoresetMode.SAME_STEP)
    return Rollouts(envs, (lambda x: x, lambda x: x), strategy or Counting(), **options)


def specs(lengths):
    """Odd and even seeds in turns; every third episode is the teacher's alone."""
    return [EpisodeSpec(n, length * 100 + n, 0.0 if n % 3 == 2 else 1.5) for n, length in enumerate(lengths)]


def expected(spec):
    """States, totals, actions, rewards of an episode, played by hand."""
    total, previous, first = 0.0, 0, 0.0
    states, totals, actions, rewards = [], [], [], []
    for clock in range(spec.seed // 100):
        if clock % N_STEPS == 0:
            first = spec.seed + 0.25 * previous + 0.5 * clock
        action = first + clock % N_STEPS
        states.append([spec.seed, clock])
        totals.append([total])
        total += action
        actions.append([action])
        rewards.append(10 * total)
        previous = clock
    return states, totals, actions, rewards


@pytest.mark.parametrize("n_envs", [1, 2, 3, 7])
def test_every_spec_yields_its_episode(n_envs):
    requested = specs([3, 5, 2, 4, 1, 6, 2])
    episodes = list(rollouts(n_envs).run(requested))
    assert sorted(episode.spec.number for episode in episodes) == list(range(7))
    for episode in episodes:
        assert episode.spec == requested[episode.spec.number]
        states, totals, actions, rewards = expected(episode.spec)
        assert episode.observations["observation.state"].tolist() == states
        np.testing.assert_allclose(episode.observations["observation.environment_state"], totals, rtol=1e-6)
        assert episode.actions.tolist() == actions
        np.testing.assert_allclose(episode.rewards, rewards, rtol=1e-6)
        assert episode.successes.tolist() == [False] * (len(episode) - 1) + [episode.spec.seed % 2 == 1]
        assert episode.task == "count down"
        assert episode.student_steps == 0 and not episode.student_alone
        clock = np.mean(range(0, len(episode), N_STEPS))
        assert episode.discrepancy == pytest.approx(clock)
        shift = float("nan") if episode.spec.teacher_only else 2 * clock
        assert episode.guidance_shift == pytest.approx(shift, nan_ok=True)
        assert episode.actions.dtype == episode.rewards.dtype == np.float32
        assert episode.observations["observation.state"].dtype == np.float32
        assert episode.successes.dtype == bool


@pytest.mark.parametrize(
    ("n_envs", "lengths", "n_steps", "order"),
    [
        (1, [3, 5, 2], 10, [0, 1, 2]),
        (2, [3, 5, 2, 4], 9, [0, 2, 1, 3]),  # slot 0: 3 + 2, slot 1: 5, then 4 in the first one
        (2, [6, 1, 1, 1], 6, [1, 2, 3, 0]),
        (3, [4, 4, 4, 4], 8, [0, 1, 2, 3]),
        (8, [2, 7], 7, [0, 1]),  # several tasks share a round's episodes, and some have few
    ],
)
def test_slots_refill_at_once(n_envs, lengths, n_steps, order):
    run = rollouts(n_envs)
    assert [episode.spec.number for episode in run.run(specs(lengths))] == order
    assert run.envs.n_steps == n_steps


def test_no_specs_no_steps():
    run = rollouts(2)
    assert list(run.run([])) == [] and run.envs.n_steps == run.envs.n_resets == 0


def test_decisions_with_their_histories_and_strengths_are_told():
    """Histories start filled, strengths travel with their slots."""
    told = []
    list(rollouts(2, on_decision=told.append).run(specs([4, 2, 2])))
    shown = [(entry.history["observation.state"].tolist(), entry.strength.tolist()) for entry in told]
    assert shown == [
        ([[[400, 0], [400, 0]], [[201, 0], [201, 0]]], [1.5, 1.5]),
        ([[[400, 1], [400, 2]], [[202, 0], [202, 0]]], [1.5, 0.0]),
    ]
    assert told[0].chunks.actions.shape == (2, N_STEPS, 1) and not told[0].student_acts.any()


def test_only_the_environments_time_is_the_rollouts():
    run = rollouts()
    list(run.run(specs([3])))
    assert set(run.strategy.stopwatch.seconds) == {"environment"} and torch.is_grad_enabled()


def test_a_diverged_chunk_is_refused_before_it_is_executed():
    run, finished = rollouts(strategy=Counting(broken_seed=201)), []
    with pytest.raises(FloatingPointError, match="not finite"):
        finished.extend(run.run(specs([3, 2])))
    assert run.envs.n_steps == 3 and len(finished) == 1, "the episode before it is safe"


def test_an_environment_that_does_not_report_success():
    (episode,) = rollouts(make=Silent).run(specs([3]))
    assert episode.successes is None and episode.is_success is None


def test_every_first_observation_is_checked_before_a_step_is_taken():
    seen = []
    list(rollouts(2, check=seen.append).run(specs([2, 1, 1])))
    firsts = [observation["observation.state"].tolist() for observation in seen]
    assert firsts == [[200, 0], [101, 0], [102, 0]]

    def refuse(observation):
        raise ValueError("another shape")

    run = rollouts(2, check=refuse)
    with pytest.raises(ValueError, match="another shape"):
        list(run.run(specs([2])))
    assert run.envs.n_steps == 0


# ---- what is recorded ----


class Relabeling(Counting):
    """Executes what its base does and records the negative of it."""

    def act(self, history, strength, student_acts=None):
        chunks = super().act(history, strength)
        return ChunkBatch(chunks.actions, chunks.discrepancy, chunks.guidance_shift, recorded=-chunks.actions)


def test_relabeled_actions_are_recorded_and_not_executed():
    (plain,), (relabeled,) = (rollouts(strategy=s).run(specs([5])) for s in (Counting(), Relabeling()))
    np.testing.assert_array_equal(relabeled.actions, -plain.actions)
    np.testing.assert_array_equal(relabeled.rewards, plain.rewards)
    for key, values in plain.observations.items():
        np.testing.assert_array_equal(relabeled.observations[key], values)


def test_both_kinds_of_actions_pass_the_environments_postprocessor():
    run = rollouts(strategy=Relabeling())
    run.postprocess = lambda transition: {"action": transition["action"] + 1000}
    (episode,), (plain,) = run.run(specs([1])), rollouts().run(specs([1]))
    assert episode.actions.tolist() == (1000 - plain.actions).tolist()
    assert episode.rewards.tolist() == (plain.rewards + 10_000).tolist()


# ---- roll-in ----


class Relay(Counting):
    """The student executes -1 and the teacher what its base does."""

    def act(self, history, strength, student_acts=None):
        chunks = super().act(history, strength)
        chunks.actions[student_acts], chunks.discrepancy[student_acts] = -1.0, float("nan")
        return chunks


def limited(steps):
    return lambda: gym.make(NAME, max_episode_steps=steps)


def rolled_in(fraction, length=7, limit=10):
    """One episode of `length` steps; seed 100 * length + 1 succeeds."""
    spec = EpisodeSpec(0, 100 * length + 1, 1.5, fraction)
    (episode,) = rollouts(strategy=Relay(), make=limited(limit)).run([spec])
    return episode


@pytest.mark.parametrize(
    ("fraction", "takeover"),
    [(0.0, 0), (0.04, 0), (0.1, 2), (0.2, 2), (0.3, 4), (0.6, 6)],  # of 10 steps, in decisions of two
)
def test_only_the_teachers_part_is_recorded(fraction, takeover):
    episode = rolled_in(fraction)
    assert episode.student_steps == takeover and not episode.student_alone and episode.is_success
    assert len(episode) == len(episode.rewards) == len(episode.successes) == 7 - takeover
    assert (episode.actions > 0).all()
    assert episode.observations["observation.state"][:, 1].tolist() == list(range(takeover, 7))
    assert episode.discrepancy == np.mean(range(takeover, 7, N_STEPS))  # of the teacher's decisions


def test_a_student_that_finishes_alone():
    episode = rolled_in(0.9)
    assert episode.student_alone and episode.student_steps == len(episode) == 7
    assert (episode.actions == -1).all() and np.isnan(episode.discrepancy) and episode.is_success


def test_slots_take_over_each_at_its_own_step():
    fractions = (0.0, 0.2, 0.5, 0.9, 0.4)
    requested = [EpisodeSpec(n, 601 + n, 1.5, fraction) for n, fraction in enumerate(fractions)]
    run = rollouts(2, strategy=Relay(), make=limited(10))
    takeovers = {episode.spec.number: episode.student_steps for episode in run.run(requested)}
    assert takeovers == {0: 0, 1: 2, 2: 6, 3: 6, 4: 4}


def test_the_students_fraction_is_of_the_environments_own_limit():
    assert step_limit(rollouts(2, make=limited(4)).envs) == 4
    episode = rolled_in(0.5, limit=4)
    assert episode.student_steps == 2 and len(episode) == 2


def test_an_environment_without_a_limit_is_refused():
    with pytest.raises(ValueError, match="--policy.collect.strategy=rollin.*_max_episode_steps"):
        list(rollouts(strategy=Relay()).run([EpisodeSpec(0, 701, 1.5, 0.5)]))
    assert len(list(rollouts(strategy=Relay()).run([EpisodeSpec(0, 701, 1.5, 0.0)]))) == 1
