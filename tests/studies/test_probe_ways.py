"""How many ways samples have: synthetic mixtures with a known answer."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from lerobot_agpd.studies.probe_ways import BETWEEN, LEAST_DISTANCE, LEAST_MEMBERS, find_ways

DIM, TRIALS = 16, 20


def smooth(rng, n: int, scale: float = 0.1) -> np.ndarray:
    """Noise of a teacher's kind: 8 steps of 2 actions that follow 3 cosines each."""
    cosines = np.cos(np.pi * np.arange(3)[:, None] * np.linspace(0, 1, 8))
    return (rng.normal(size=(n, 2, 3)) * scale / np.arange(1, 4) @ cosines).reshape(n, DIM)


def mixture(seed: int, weights, n: int = 256) -> np.ndarray:
    """Samples around orthogonal centers, an rms distance of 0.5 apart: five standard deviations of the noise."""
    rng = np.random.default_rng(seed)
    rotation = np.linalg.qr(rng.normal(size=(DIM, DIM)))[0]
    centers = rotation[: len(weights)] * 0.5 * np.sqrt(DIM / 2)
    return centers[rng.choice(len(weights), n, p=weights)] + smooth(rng, n)


@pytest.mark.parametrize(
    "weights",
    [[1.0], [0.5, 0.5], [0.8, 0.2], [1 / 3] * 3, [0.6, 0.3, 0.1], [1 / 8] * 8],
    ids=["one", "two", "two uneven", "three", "three uneven", "eight"],
)
def test_the_ways_are_counted(weights):
    found = [len(find_ways(mixture(seed, weights))) for seed in range(TRIALS)]
    assert np.mean(np.array(found) == len(weights)) >= 0.9, found


def one_dimension(rng):
    return rng.normal(size=(128, 1)) * rng.normal(size=DIM)


def arc(rng):
    angle = rng.uniform(-2, 2, 128)
    points = np.zeros((128, DIM))
    points[:, 0], points[:, 1] = np.cos(angle), np.sin(angle)
    return points + 0.05 * rng.normal(size=points.shape)


SINGLE = {
    "round": lambda rng: 0.1 * rng.normal(size=(128, DIM)),
    "a line": one_dimension,
    "anisotropic": lambda rng: rng.normal(size=(128, DIM)) * np.geomspace(1, 0.01, DIM),
    "an arc": arc,
    "smooth": lambda rng: smooth(rng, 128),
    "heavy tails": lambda rng: 0.1 * rng.standard_t(3, size=(128, DIM)),
    "clipped": lambda rng: np.clip(rng.normal(size=(128, DIM)) + 0.8, -1, 1),
    "a skewed line": lambda rng: rng.exponential(size=(128, 1)) * rng.normal(size=DIM),
}


@pytest.mark.parametrize("shape", SINGLE)
def test_one_way_of_any_shape_is_one(shape):
    several = [len(find_ways(SINGLE[shape](np.random.default_rng(seed)))) > 1 for seed in range(100)]
    assert np.mean(several) <= 0.05


def test_a_deterministic_teacher_has_one_way():
    ways = find_ways(np.full((32, 4), 0.5))
    assert len(ways) == 1 and ways.weights.tolist() == [1.0] and ways.radii.tolist() == [0.0]
    assert ways.distances.tolist() == []


def test_numbers_of_two_known_ways():
    """36 samples at 0 and 12 at 1, in each of 4 dimensions."""
    samples = np.repeat([0.0, 1.0], [36, 12])[:, None] + np.zeros((48, 4))
    ways = find_ways(samples)
    assert ways.weights.tolist() == [0.75, 0.25] and ways.distances.tolist() == [1.0]
    assert ways.centers.tolist() == [[0.0] * 4, [1.0] * 4]
    assert ways.nearest(np.array([[0.4] * 4, [0.6] * 4])).tolist() == [0, 1]
    median, mean = np.median(samples, axis=0), samples.mean(axis=0)  # 0 and 0.25
    # A way of no width counts as LEAST_DISTANCE / 2 = 0.025 wide: 0.25 is 10 radii away.
    np.testing.assert_allclose(ways.remoteness(np.stack([median, mean])), [0, 10])


def test_the_median_of_three_ways_in_a_plane_is_none_and_of_three_on_a_line_is_one():
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [0.5, 1.0]])
    line = np.array([[0.0, 0.0], [0.5, 0.0], [1.0, 0.0]])
    noise = 0.01 * np.random.default_rng(0).normal(size=(60, 2))
    for centers, is_way in ((corners, False), (line, True)):
        samples = np.repeat(centers, 20, axis=0) + noise
        ways = find_ways(samples)
        assert len(ways) == 3
        assert (ways.remoteness(np.median(samples, axis=0)[None])[0] <= 1) == is_way


def test_few_samples_between_two_ways_do_not_join_them():
    rng = np.random.default_rng(0)
    sides = np.repeat([[-1.0] * DIM, [1.0] * DIM], 60, axis=0) + smooth(rng, 120)
    bridge = np.linspace(-0.9, 0.9, 6)[:, None] + np.zeros(DIM)
    ways = find_ways(np.concatenate([sides, bridge]))
    assert len(ways) == 2
    assert (ways.labels[120:] == BETWEEN).any() and (ways.labels[:120] != BETWEEN).mean() > 0.95


@pytest.mark.parametrize(("apart", "count"), [(0.9, 1), (1.1, 2)])
def test_ways_closer_than_the_least_distance_are_one(apart, count):
    samples = np.repeat([[0.0] * 4, [apart * LEAST_DISTANCE] * 4], 20, axis=0)
    assert len(find_ways(samples)) == count


def test_too_few_samples():
    with pytest.raises(ValueError, match=f"at least {2 * LEAST_MEMBERS} samples"):
        find_ways(np.zeros((2 * LEAST_MEMBERS - 1, 3)))


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 1000), st.permutations(range(64)))
def test_the_order_of_samples_does_not_matter(seed, order):
    samples = mixture(seed, [0.5, 0.5], n=64)
    ways, shuffled = find_ways(samples), find_ways(samples[list(order)])
    assert len(ways) == len(shuffled)
    np.testing.assert_allclose(np.sort(ways.weights), np.sort(shuffled.weights))
    assert ways.weights.sum() <= 1 + 1e-9
