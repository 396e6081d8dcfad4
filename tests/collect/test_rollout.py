"""Rollouts against a deterministic environment simulated by hand."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from lerobot_agpd.collect.rollout import Decision, Rollouts, Stopwatch
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
        self.decisions = []

    def decide(self, history, scale):
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


def rollouts(n_envs, decider, make=lambda: gym.make(NAME)) -> Rollouts:
    envs = Counting([make] * n_envs, autoreset_mode=AutoresetMode.SAME_STEP)
    return Rollouts(envs, (lambda x: x, lambda x: x), decider, Stopwatch())


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
        def decide(self, history, scale):
            seen.append(torch.is_grad_enabled())
            return super().decide(history, scale)

    run = rollouts(1, Watching())
    list(run.run(tickets([3])))
    assert seen == [False, False] and torch.is_grad_enabled()
    assert set(run.stopwatch.seconds) == {"decisions", "environment"}
    assert all(seconds > 0 for seconds in run.stopwatch.seconds.values())


def test_diverged_chunk_is_refused_before_it_is_executed():
    run = rollouts(1, Decider(broken_seed=201))
    finished = []
    with pytest.raises(FloatingPointError, match="not finite"):
        finished.extend(run.run(tickets([3, 2])))
    assert run.envs.n_steps == 3


def test_environment_that_does_not_report_success():
    (episode,) = rollouts(1, Decider(), make=Silent).run(tickets([3]))
    assert episode.successes is None and episode.success is None


def test_no_tickets_no_steps():
    run = rollouts(2, Decider())
    assert list(run.run([])) == [] and run.envs.n_steps == run.envs.n_resets == 0
