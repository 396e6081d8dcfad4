"""As many environments as can be busy, kept from round to round."""

from hypothesis import given, strategies as st
from point_environment import LIMIT, PointEnv

from lerobot_agpd.rollout.kept_environments import KeptEnvironments, slots


@given(st.integers(1, 500), st.integers(1, 64))
def test_slots_need_no_more_waves_and_none_could_be_spared(n_episodes, most):
    n, waves = slots(n_episodes, most), -(-n_episodes // most)
    assert 1 <= n <= most and n * waves >= n_episodes > (n - 1) * waves


def test_fifty_episodes_on_sixteen_environments():
    assert slots(50, 16) == 13  # four waves; with sixteen slots the last one would have two of them busy


def test_environments_are_built_anew_for_another_number_only():
    kept = KeptEnvironments(PointEnv(), use_async=False)
    [first] = kept.of_size(2)
    assert kept.of_size(2) == [first] and first.num_envs == 2
    [other] = kept.of_size(3)
    assert other.num_envs == 3 and first.closed
    kept.close()
    assert other.closed and kept.of_size(3) != [other]
    kept.close()


def test_they_know_their_step_limit():
    """Before and after they are built."""
    unbuilt, built = (KeptEnvironments(PointEnv(), use_async=False) for _ in range(2))
    built.of_size(2)
    assert unbuilt.step_limit == built.step_limit == LIMIT
    built.close()
