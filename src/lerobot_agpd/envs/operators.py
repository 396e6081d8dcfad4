"""Operators of limited skill: a scripted expert that hesitates, trembles, takes detours, makes mistakes and recovers.

What an operator *intends* stays a pure function of the observation: the expert's action, slower and on a bent path.
Tremor, pauses and slips are noise on top, which no observation shows, as with people. After a slip of a few steps the
expert goes on from the new situation.

Human data mix operators in the same way; the multi-human sets of robomimic (arXiv:2108.03298) are the model for a list
of skills.
"""

import math

import numpy as np

from lerobot_agpd.envs.experts.base import Array, Expert, Observation

# Values at skill 0; all fall linearly to nothing at skill 1.
# Fraction of the speed that is lost.
SLOWNESS = 0.3
# Largest turn of the horizontal heading.
DETOUR_ANGLE = math.radians(60)
# Meters of hand travel after which the turn repeats.
DETOUR_WAVELENGTH = 0.20
# Standard deviation of the noise on the motion, action units.
TREMOR = 0.3
# Pauses begun per step.
PAUSE_RATE = 0.05
# Slips begun per step.
SLIP_RATE = 0.04

# Correlation of the tremor from one step to the next.
TREMOR_CORRELATION = 0.7
# Shortest and longest pause and slip.
PAUSE_STEPS = (2, 6)
SLIP_STEPS = (2, 5)


def bent_path(action: Array, hand: Array, skill: float) -> Array:
    """Slow an action down and turn its horizontal heading by an angle that depends on where the hand is.

    The angle stays below 90 degrees: every step still gets closer to the expert's goal.

    Args:
        action: (4,) displacement x, y, z in [-1, 1], and gripper.
        hand: (3,) position of the hand, meters.
        skill: 1 returns the action unchanged, 0 bends it most.

    Returns:
        (4,) action.
    """
    lapse = 1.0 - skill
    phase = 2 * math.pi * (hand[0] + hand[1]) / DETOUR_WAVELENGTH
    turn = lapse * DETOUR_ANGLE * math.sin(phase)
    x, y = action[:2]
    cos, sin = math.cos(turn), math.sin(turn)
    turned = np.array([cos * x - sin * y, sin * x + cos * y, action[2]])
    return np.append((1.0 - SLOWNESS * lapse) * turned, action[3])


class Lapses:
    """Random lapses of one hand: tremor, pauses and slips."""

    def __init__(self, lapse: float, rng: np.random.Generator) -> None:
        """Begin an episode.

        Args:
            lapse: 1 minus the skill, in [0, 1].
            rng: source of tremor, pauses and slips.
        """
        self._lapse = lapse
        self._rng = rng
        self._tremor: Array = np.zeros(3)
        self._pause_left = 0
        self._slip_left = 0
        self._slip_intention: Array = np.zeros(4)

    def disturb(self, intention: Array) -> Array:
        """Return the action (4,) of the hand instead of its intention (4,), for one step."""
        intention = self._slip(self._pause(intention))
        return intention + np.append(self._next_tremor(), 0.0)

    def _next_tremor(self) -> Array:
        """First-order autoregressive noise with a stationary standard deviation of `TREMOR` times the lapse."""
        innovation = math.sqrt(1.0 - TREMOR_CORRELATION**2) * self._lapse * TREMOR
        self._tremor = TREMOR_CORRELATION * self._tremor + innovation * self._rng.standard_normal(3)
        return self._tremor

    def _pause(self, intention: Array) -> Array:
        """Stand still for a few steps now and then; the fingers do what they did."""
        self._pause_left = self._next_count(self._pause_left, PAUSE_RATE, PAUSE_STEPS)
        return np.append(np.zeros(3), intention[3]) if self._pause_left else intention

    def _slip(self, intention: Array) -> Array:
        """Move off in a random direction for a few steps now and then, the gripper doing the opposite."""
        before = self._slip_left
        self._slip_left = self._next_count(self._slip_left, SLIP_RATE, SLIP_STEPS)
        if self._slip_left > before:  # a new one
            direction = self._rng.standard_normal(3)
            self._slip_intention = np.append(direction / np.linalg.norm(direction), -intention[3])
        return self._slip_intention if self._slip_left else intention

    def _next_count(self, left: int, rate: float, steps: tuple[int, int]) -> int:
        """Steps left of a pause or slip: count down, or begin one with probability `rate` times the lapse."""
        if left > 1:
            return left - 1
        if self._rng.random() < self._lapse * rate:
            return int(self._rng.integers(steps[0], steps[1] + 1))
        return 0


class Operator:
    """An expert played with some skill, for one episode.

    At skill 1 it is the expert, bit for bit, and draws no random number.
    """

    def __init__(self, expert: Expert, skill: float, rng: np.random.Generator) -> None:
        """Begin an episode.

        Args:
            expert: whose intentions are carried out.
            skill: in [0, 1].
            rng: source of tremor, pauses and slips.

        Raises:
            ValueError: if the skill is outside [0, 1].
        """
        if not 0.0 <= skill <= 1.0:
            raise ValueError(f"A skill lies in [0, 1], got {skill}.")
        self.expert = expert
        self.skill = skill
        self._rng = rng
        self._lapses: list[Lapses] = []  # one per hand

    def __call__(self, observation: Observation) -> np.ndarray:
        """Action (A,), float32, on one raw observation of a single environment."""
        if self.skill == 1.0:
            return self.expert(observation)
        intentions = self.expert.intentions(observation)  # (H, 4)
        hands = self.expert.hands(observation)  # (H, 3)
        while len(self._lapses) < len(intentions):
            self._lapses.append(Lapses(1.0 - self.skill, self._rng))
        disturbed = [
            lapses.disturb(bent_path(intention, hand, self.skill))
            for lapses, intention, hand in zip(self._lapses, intentions, hands, strict=True)
        ]
        return self.expert.act(observation, np.clip(disturbed, -1.0, 1.0))
