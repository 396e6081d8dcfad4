"""The sample of a round's observations at which its diagnostics sample again."""

import torch
from toy_policies import STATE, histories, make_pair, noise

from lerobot_agpd.rollout.diagnostics import ObservationReservoir
from lerobot_agpd.rollout.rollout import Decision
from lerobot_agpd.rollout.strategies import TeacherStrategy


def decision(first, n, student_acts=None) -> Decision:
    """One whose states and tasks are numbered."""
    numbers = range(first, first + n)
    state = torch.tensor(numbers).float()[:, None, None].expand(n, 2, 2)
    history = {STATE: state, "task": [str(number) for number in numbers]}
    chunks = TeacherStrategy(make_pair(), noise()).act(histories(n), torch.zeros(n))
    acts = torch.zeros(n, dtype=torch.bool) if student_acts is None else torch.tensor(student_acts)
    return Decision(history, torch.ones(n), acts, chunks, noise().get_state())


def sampled(reservoir) -> list[int]:
    history = reservoir.history()
    states = history[STATE][:, -1, 0].int().tolist()
    assert history["task"] == [str(state) for state in states]
    return states


def test_few_decisions_are_all_kept_and_no_random_number_is_taken_from_others():
    reservoir, before = ObservationReservoir(seed=5, size=10), torch.get_rng_state()
    assert reservoir.history() is None
    reservoir(decision(0, 3))
    assert sampled(reservoir) == [0, 1, 2]
    assert torch.equal(before, torch.get_rng_state())


def test_the_sample_is_uniform():
    """Each of 20 decisions is among 5 kept in 0.25 +- 4 standard deviations (0.022) of 400 trials."""
    counts, decisions = torch.zeros(20), [decision(first, 4) for first in range(0, 20, 4)]
    for seed in range(400):
        reservoir = ObservationReservoir(seed, size=5)
        for entry in decisions:
            reservoir(entry)
        kept = sampled(reservoir)
        assert len(set(kept)) == 5
        counts[kept] += 1
    assert ((counts / 400 - 0.25).abs() < 0.087).all()


def test_decisions_of_the_student_are_left_out():
    reservoir = ObservationReservoir(seed=5, size=10)
    reservoir(decision(0, 4, [True, False, True, False]))
    assert sampled(reservoir) == [1, 3]
