"""Count the ways that a teacher knows in one state: clusters of its samples.

Ways are the well separated peaks of the density that the samples come from. Their number is not known, a way may be
rare, curved or long, and one chunk has tens of dimensions, so nothing is fitted: the tree of HDBSCAN (Campello, Moulavi &
Sander 2013), single linkage of mutual reachability distances, is cut wherever the gap between two groups is wide for how
densely both are sampled. docs/probe.md says how often this errs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import cast

import numpy as np
from scipy.cluster.hierarchy import ClusterNode, linkage, to_tree
from scipy.spatial.distance import cdist, squareform

from lerobot_agpd.replay.episode import Array

LEAST_WEIGHT = 0.05
"""Least fraction of a state's samples that makes a way; what is less stands between the ways."""

LEAST_MEMBERS = 12
"""Least number of samples that makes a way: fewer clump by chance."""

GAP = 2.0
"""Two groups are two ways if the gap between them is this many times the distance of neighbors within either."""

LEAST_DISTANCE = 0.05
"""Ways whose centers are nearer, as a root mean square over steps and dimensions of the normalized actions, are one."""

RADIUS_QUANTILE = 0.95
"""Fraction of a way's samples that lie within its radius."""

BETWEEN = -1
"""Label of a sample that belongs to no way."""


@dataclass(frozen=True)
class Ways:
    """The ways among K samples of one state, the most frequent first.

    Attributes:
        labels: (K,) the way of every sample, or BETWEEN.
        centers: (W, D) mean of each way's samples.
        radii: (W,) root-mean-square distance from the center within which RADIUS_QUANTILE of its samples lie.
    """

    labels: Array
    centers: Array
    radii: Array

    def __len__(self) -> int:
        """Number of ways W."""
        return len(self.centers)

    @property
    def weights(self) -> Array:
        """Fraction of the samples on each way, (W,); their sum leaves out those between."""
        return np.array([np.mean(self.labels == way) for way in range(len(self))])

    @property
    def distances(self) -> Array:
        """Root-mean-square distances between the centers, one per pair of ways."""
        pairs = np.triu_indices(len(self), 1)
        return _rms(self.centers, self.centers)[pairs]

    def nearest(self, chunks: Array) -> Array:
        """The way whose center is nearest to each of the chunks (N, D), (N,)."""
        return _rms(chunks, self.centers).argmin(axis=1)

    def remoteness(self, chunks: Array) -> Array:
        """Distance of chunks (N, D) from the nearest way, in that way's radii, (N,): above 1 they are no way.

        A radius is at least half of LEAST_DISTANCE, as wide as a way may be.
        """
        radii = np.maximum(self.radii, LEAST_DISTANCE / 2)
        return (_rms(chunks, self.centers) / radii).min(axis=1)


def find_ways(samples: Array) -> Ways:
    """Find the ways among the samples of one state.

    Args:
        samples: (K, D) flattened chunks in the teacher's normalized action space.

    Raises:
        ValueError: for fewer than 2 * LEAST_MEMBERS samples.
    """
    points = np.asarray(samples, dtype=float)
    if len(points) < 2 * LEAST_MEMBERS:
        raise ValueError(f"ways need at least {2 * LEAST_MEMBERS} samples of a state, got {len(points)}")
    distances = cdist(points, points) / math.sqrt(points.shape[1])
    groups = _Tree(distances).ways()
    groups = _merge_close(points, groups)
    if len(groups) == 1:  # what stands apart from the only way is its tail
        groups = [np.arange(len(points))]
    groups.sort(key=len, reverse=True)
    labels = np.full(len(points), BETWEEN)
    for way, members in enumerate(groups):
        labels[members] = way
    centers = np.stack([points[members].mean(axis=0) for members in groups])
    radii = [
        np.quantile(_rms(points[members], center[None])[:, 0], RADIUS_QUANTILE)
        for members, center in zip(groups, centers, strict=True)
    ]
    return Ways(labels, centers, np.array(radii))


class _Tree:
    """Single-linkage tree of mutual reachability distances, and its significant cuts."""

    def __init__(self, distances: Array):
        self.least = max(LEAST_MEMBERS, math.ceil(LEAST_WEIGHT * len(distances)))
        # Distance to the neighbor that completes a group of the least size: small where samples are dense.
        self.core = np.sort(distances, axis=1)[:, self.least - 1]
        reachability = np.maximum(distances, np.maximum(self.core[:, None], self.core[None]))
        np.fill_diagonal(reachability, 0)
        self.root = cast(ClusterNode, to_tree(linkage(squareform(reachability, checks=False), "single")))

    def ways(self) -> list[Array]:
        """Members of every way."""
        return self._split(self.root)

    def _split(self, node: ClusterNode) -> list[Array]:
        """The ways below a node; one, if nothing below it is significant."""
        core = node
        while not core.is_leaf():  # follow the large branch past single samples that fall off
            left, right = core.get_left(), core.get_right()
            if min(left.get_count(), right.get_count()) >= self.least:
                parts = [self._split(left), self._split(right)]
                if max(map(len, parts)) > 1 or self._is_gap(core.dist, left, right):
                    return parts[0] + parts[1]
                break
            core = left if left.get_count() > right.get_count() else right
        return [np.array(node.pre_order())]

    def _is_gap(self, width: float, *sides: ClusterNode) -> bool:
        return width > GAP * max(float(np.median(self.core[side.pre_order()])) for side in sides)


def _merge_close(points: Array, groups: list[Array]) -> list[Array]:
    """Join groups whose centers are within LEAST_DISTANCE, the closest pair first."""
    groups = list(groups)
    while len(groups) > 1:
        centers = np.stack([points[members].mean(axis=0) for members in groups])
        apart = _rms(centers, centers) + np.diag(np.full(len(groups), np.inf))
        first, second = sorted(np.unravel_index(apart.argmin(), apart.shape))
        if apart[first, second] >= LEAST_DISTANCE:
            break
        groups[first] = np.concatenate([groups[first], groups.pop(second)])
    return groups


def _rms(chunks: Array, centers: Array) -> Array:
    """Root-mean-square distances (N, W) of chunks (N, D) from centers (W, D)."""
    return cdist(chunks, centers) / math.sqrt(centers.shape[1])
