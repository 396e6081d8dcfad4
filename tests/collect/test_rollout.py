"""Rollouts against a deterministic environment simulated by hand."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from lerobot_agpd.collect.config import RollinConfig
from lerobot_agpd.collect.decider import Decision
from lerobot_agpd.collect.rollout import Rollouts, step_limit
from lerobot_agpd.collect.stopwatch import Stopwatch
from lerobot_agpd.replay.episode import Ticket

NAME = "lerobot_agpd_tests/Countdown-v0"
N_STEPS = 2  # executed steps per decision


class Countdown(gym.Env):
    """Sums its actions; a seed of length * 100 + anything gives `length` steps, an odd one succeeds at the last.

    Without a seed (autoreset) the episode is one no ticket asked for.
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
        self.ticket_seed, self.clock, self.total = (-700 if seed is None else seed), 0, 0.0
        return self._observation(), {}

    def _observation(self):
        return {
            "agent_pos": np.array([self.ticket_seed, self.clock], dtype=np.float64),
            "environment_state": np.array([self.total]),
        }

    def step(self, action):
        self.clock += 1
        self.total += float(action[0])
        done = self.clock >= abs(self.ticket_seed) // 100
        info = {"is_success": done and self.ticket_seed % 2 == 1} if self.reports_success else {}
        return self._observation(), 10 * self.total, done, False, info


class Silent(Countdown):
    reports_success = False


@pytest.fixture(scope="module", autouse=True)
def registered():
    gym.register(NAME, entry_point=Countdown)
    yield
    gym.registry.pop(NAME)


class Decider:
    """Executes seed + (previous clock, clock) + 0, 1, ...: an action that shows what its decision has seen."""

    n_obs_steps = 2

    def __init__(self, broken_seed=None):
        self.broken_seed = broken_seed
        self.stopwatch = Stopwatch()
        self.decisions = []

    def decide(self, history, scale, rolling_in=None):
        assert history["task"] == ["count down"] * len(scale)
        state = history["observation.state"]  # (B, 2, 2)
        assert state.shape[1:] == (2, 2) and history["observation.environment_state"].shape[1:] == (2, 1)
        self.decisions.append((state.clone(), scale.clone()))
        first = state[:, -1, 0] + 0.25 * state[:, 0, 1] + 0.5 * state[:, 1, 1]
        actions = first[:, None, None] + torch.arange(N_STEPS).view(1, -1, 1)
        if self.broken_seed is not None:
            actions[state[:, -1, 0] == self.broken_seed, -1] = float("nan")
        clock = state[:, 1, 1]
        return Decision(actions=actions, j=clock, shift=torch.where(scale > 0, 2 * clock, torch.nan))


class Counting(SyncVectorEnv):
    n_steps = n_resets = 0

    def step(self, actions):
        self.n_steps += 1
        return super().step(actions)

    def reset(self, **options):
        self.n_resets += 1
        return super().reset(**options)


def rollouts(n_envs, decider, make=lambda: gym.make(NAME), rollin=None) -> Rollouts:
    envs = Counting([make] * n_envs, autoreset_mode=AutoresetMode.SAME_STEP)
    return Rollouts(envs, (lambda x: x, lambda x: x), decider, rollin)


def tickets(lengths):
    """Odd and even seeds in turns; every third episode is unguided."""
    return [Ticket(n, length * 100 + n, 0.0 if n % 3 == 2 else 1.5) for n, length in enumerate(lengths)]


def expected(ticket):
    """States, totals, actions, rewards of an episode, played by hand."""
    length, total, previous = ticket.seed // 100, 0.0, 0
    states, totals, actions, rewards = [], [], [], []
    for clock in range(length):
        if clock % N_STEPS == 0:
            first = ticket.seed + 0.25 * previous + 0.5 * clock
        action = first + clock % N_STEPS
        states.append([ticket.seed, clock])
        totals.append([total])
        total += action
        actions.append([action])
        rewards.append(10 * total)
        previous = clock
    return states, totals, actions, rewards


@pytest.mark.parametrize("n_envs", [1, 2, 3, 7])
def test_every_ticket_yields_its_episode(n_envs):
    asked = tickets([3, 5, 2, 4, 1, 6, 2])
    episodes = list(rollouts(n_envs, Decider()).run(asked))
    assert sorted(episode.ticket.number for episode in episodes) == list(range(7))
    for episode in episodes:
        assert episode.ticket == asked[episode.ticket.number]
        states, totals, actions, rewards = expected(episode.ticket)
        assert episode.observations["observation.state"].tolist() == states
        np.testing.assert_allclose(episode.observations["observation.environment_state"], totals, rtol=1e-6)
        assert episode.actions.tolist() == actions
        np.testing.assert_allclose(episode.rewards, rewards, rtol=1e-6)
        assert episode.successes.tolist() == [False] * (len(episode) - 1) + [episode.ticket.seed % 2 == 1]
        assert episode.task == "count down"
        assert episode.student_steps == 0 and not episode.student_alone
        clocks = range(0, len(episode), N_STEPS)
        assert episode.j == pytest.approx(np.mean(clocks))
        assert episode.shift == pytest.approx(
            2 * np.mean(clocks) if episode.ticket.guided else float("nan"), nan_ok=True
        )


def test_dtypes():
    (episode,) = rollouts(1, Decider()).run(tickets([3]))
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
    ],
)
def test_slots_refill_at_once(n_envs, lengths, n_steps, order):
    run = rollouts(n_envs, Decider())
    assert [episode.ticket.number for episode in run.run(tickets(lengths))] == order
    assert run.envs.n_steps == n_steps


def test_more_slots_than_tickets():
    """Happens with several tasks, among which a round's tickets are dealt."""
    run = rollouts(8, Decider())
    assert [episode.ticket.number for episode in run.run(tickets([2, 7]))] == [0, 1]
    assert run.envs.n_steps == 7


def test_histories_start_filled_and_scales_travel_with_their_slots():
    decider = Decider()
    list(rollouts(2, decider).run(tickets([4, 2, 2])))
    shown = [(state.tolist(), scale.tolist()) for state, scale in decider.decisions]
    assert shown == [
        ([[[400, 0], [400, 0]], [[201, 0], [201, 0]]], [1.5, 1.5]),
        ([[[400, 1], [400, 2]], [[202, 0], [202, 0]]], [1.5, 0.0]),
    ]


def test_decisions_run_without_gradients_and_time_is_taken():
    seen = []

    class Watching(Decider):
        def decide(self, history, scale, rolling_in=None):
            seen.append(torch.is_grad_enabled())
            return super().decide(history, scale, rolling_in)

    run = rollouts(1, Watching())
    list(run.run(tickets([3])))
    assert seen == [False, False] and torch.is_grad_enabled()
    assert set(run.decider.stopwatch.seconds) == {"environment"}
    assert run.decider.stopwatch.seconds["environment"] > 0


def test_diverged_chunk_is_refused_before_it_is_executed():
    run = rollouts(1, Decider(broken_seed=201))
    finished = []
    with pytest.raises(FloatingPointError, match="not finite"):
        finished.extend(run.run(tickets([3, 2])))
    assert run.envs.n_steps == 3


def test_environment_that_does_not_report_success():
    (episode,) = rollouts(1, Decider(), make=Silent).run(tickets([3]))
    assert episode.successes is None and episode.success is None


def test_every_first_observation_is_checked_before_a_step_is_taken():
    run, seen = rollouts(2, Decider()), []
    run.check = seen.append
    list(run.run(tickets([2, 1, 1])))
    assert [observation["observation.state"].tolist() for observation in seen] == [
        [200, 0],
        [101, 0],
        [102, 0],
    ]

    def refuse(observation):
        raise ValueError("another shape")

    run = rollouts(2, Decider())
    run.check = refuse
    with pytest.raises(ValueError, match="another shape"):
        list(run.run(tickets([2])))
    assert run.envs.n_steps == 0


def test_no_tickets_no_steps():
    run = rollouts(2, Decider())
    assert list(run.run([])) == [] and run.envs.n_steps == run.envs.n_resets == 0


# ---- what is recorded ----


class Relabelling(Decider):
    """Executes what its base does and records the negative of it."""

    def decide(self, history, scale, rolling_in=None):
        decision = super().decide(history, scale)
        return Decision(decision.actions, decision.j, decision.shift, recorded=-decision.actions)


def test_relabelled_actions_are_recorded_and_not_executed():
    (plain,), (relabelled,) = (
        rollouts(1, decider).run(tickets([5])) for decider in (Decider(), Relabelling())
    )
    np.testing.assert_array_equal(relabelled.actions, -plain.actions)
    np.testing.assert_array_equal(relabelled.rewards, plain.rewards)
    np.testing.assert_array_equal(
        relabelled.observations["observation.environment_state"],
        plain.observations["observation.environment_state"],
    )


def test_both_kinds_of_actions_pass_the_environments_postprocessor():
    run = rollouts(1, Relabelling())
    run.postprocess = lambda transition: {"action": transition["action"] + 1000}
    (episode,), (plain,) = run.run(tickets([1])), rollouts(1, Decider()).run(tickets([1]))
    assert episode.actions.tolist() == (1000 - plain.actions).tolist()
    assert episode.rewards.tolist() == (plain.rewards + 10_000).tolist()


# ---- roll-in ----


class Relay(Decider):
    """The student executes -1 and the teacher what its base does; remembers who decided."""

    def decide(self, history, scale, rolling_in=None):
        decision = super().decide(history, scale)
        actions, j = decision.actions.clone(), decision.j.clone()
        actions[rolling_in], j[rolling_in] = -1.0, float("nan")
        return Decision(actions, j, decision.shift)


def rolled_in(share, record_student=False, episode_steps=10, length=7):
    """One episode of `length` steps; seed 100 * length + 1 succeeds."""
    rollin = RollinConfig(episode_steps=episode_steps, record_student=record_student)
    ticket = Ticket(0, 100 * length + 1, 1.5, share)
    (episode,) = rollouts(1, Relay(), rollin=rollin).run([ticket])
    return episode


@pytest.mark.parametrize(
    ("share", "takeover"),
    [(0.0, 0), (0.04, 0), (0.1, 2), (0.2, 2), (0.3, 4), (0.6, 6)],  # of 10 steps, in decisions of two
)
def test_only_the_teachers_part_is_recorded(share, takeover):
    episode = rolled_in(share)
    whole = rolled_in(share, record_student=True)
    for part in (episode, whole):
        assert part.student_steps == takeover and not part.student_alone
        assert part.success
    assert len(whole) == 7 and len(episode) == 7 - takeover
    assert (whole.actions[:takeover] == -1).all() and (whole.actions[takeover:] > 0).all()
    np.testing.assert_array_equal(episode.actions, whole.actions[takeover:])
    np.testing.assert_array_equal(episode.rewards, whole.rewards[takeover:])
    np.testing.assert_array_equal(episode.successes, whole.successes[takeover:])
    states = episode.observations["observation.state"]
    assert states[:, 1].tolist() == list(range(takeover, 7))
    assert episode.j == np.mean(range(takeover, 7, N_STEPS))  # of the teacher's decisions


@pytest.mark.parametrize("record_student", [False, True])
def test_student_that_finishes_alone(record_student):
    episode = rolled_in(0.9, record_student)
    assert episode.student_alone and episode.student_steps == len(episode) == 7
    assert (episode.actions == -1).all() and np.isnan(episode.j) and episode.success


def test_slots_take_over_each_at_its_own_step():
    asked = [Ticket(n, 601 + n, 1.5, share) for n, share in enumerate((0.0, 0.2, 0.5, 0.9, 0.4))]
    run = rollouts(2, Relay(), rollin=RollinConfig(episode_steps=10))
    found = {episode.ticket.number: episode.student_steps for episode in run.run(asked)}
    assert found == {0: 0, 1: 2, 2: 6, 3: 6, 4: 4}


def test_share_is_of_the_environments_own_limit():
    def limited():
        return gym.make(NAME, max_episode_steps=4)

    assert step_limit(rollouts(2, Decider(), make=limited).envs) == 4
    (episode,) = rollouts(1, Relay(), make=limited).run([Ticket(0, 701, 1.5, 0.5)])
    assert episode.student_steps == 2 and len(episode) == 2


def test_environment_without_a_limit_is_refused():
    with pytest.raises(ValueError, match="--policy.collect.rollin.episode_steps"):
        list(rollouts(1, Relay()).run([Ticket(0, 701, 1.5, 0.5)]))
    assert len(list(rollouts(1, Relay()).run([Ticket(0, 701, 1.5, 0.0)]))) == 1  # nobody asks
