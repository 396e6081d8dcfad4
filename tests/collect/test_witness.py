import torch
from toy_policies import STATE, histories, make_pair, noise

from lerobot_agpd.collect.deciders.teacher import GuidedTeacher
from lerobot_agpd.collect.witness import Witness
from lerobot_agpd.guidance.config import GuidanceConfig


def guided() -> GuidedTeacher:
    return GuidedTeacher(make_pair(), noise(), GuidanceConfig())


def numbered(first, n):
    """Histories whose states say which decision they belong to."""
    state = torch.arange(first, first + n).float()[:, None, None].expand(n, 2, 2)
    return {STATE: state, "task": [str(number) for number in range(first, first + n)]}


def seen(witness) -> list[int]:
    history = witness.history()
    states = history[STATE][:, -1, 0].int().tolist()
    assert history["task"] == [str(state) for state in states]
    return states


def test_decisions_are_those_of_the_watched_strategy():
    plain, watched = guided(), Witness(guided(), size=2, seed=5)
    assert watched.n_obs_steps == plain.n_obs_steps and watched.stopwatch is watched.decider.stopwatch
    for round_ in range(4):
        history = histories(seed=round_)
        ours, theirs = plain.decide(history, torch.ones(5)), watched.decide(history, torch.ones(5))
        assert torch.equal(ours.actions, theirs.actions) and torch.equal(ours.j, theirs.j)


def test_global_random_numbers_are_left_alone():
    before = torch.get_rng_state()
    Witness(guided(), size=1, seed=5).decide(histories(), torch.ones(5))
    assert torch.equal(before, torch.get_rng_state())


def test_few_decisions_are_all_kept():
    witness = Witness(guided(), size=10, seed=5)
    assert witness.history() is None
    witness.decide(numbered(0, 3), torch.ones(3))
    assert seen(witness) == [0, 1, 2]


def test_sample_is_uniform():
    """Each of 20 decisions is among 5 kept in 0.25 +- 4 standard deviations (0.022) of 400 trials."""
    counts = torch.zeros(20)
    for seed in range(400):
        witness = Witness(guided(), size=5, seed=seed)
        for first in range(0, 20, 4):
            witness.decide(numbered(first, 4), torch.ones(4))
        kept = seen(witness)
        assert len(set(kept)) == 5
        counts[kept] += 1
    assert ((counts / 400 - 0.25).abs() < 0.087).all()


def test_decisions_of_the_student_are_left_out():
    witness = Witness(guided(), size=10, seed=5)
    witness.decide(numbered(0, 4), torch.ones(4), torch.tensor([True, False, True, False]))
    assert seen(witness) == [1, 3]
