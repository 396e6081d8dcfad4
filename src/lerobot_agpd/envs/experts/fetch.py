"""Scripted experts for the Fetch tasks: pure functions of one observation.

An expert has no memory: its action follows from the current geometry, so a policy cloned from the demonstrations
observes everything that its expert observed. Stages blend into each other over a few millimeters or centimeters
instead of switching, so that actions change smoothly.
"""

from dataclasses import dataclass

import numpy as np

from lerobot_agpd.envs.experts.base import Array, Expert, descend, ramp, state_vectors

# Action units per meter of position error. An action of 1 asks for 5 cm in one step; the arm follows with a lag.
POSITION_GAIN = 10.0

OPEN, CLOSE = 1.0, -1.0

# Height of the hand above the block's center before it comes down to grasp or to push, meters.
GRASP_CLEARANCE = 0.10
PUSH_CLEARANCE = 0.08
# Distance from the block's center at which the hand comes down, and at which it touches, meters.
PUSH_STANDOFF = 0.065
PUSH_CONTACT = 0.04
# How far ahead of itself a pushing hand aims at most, meters: this bounds the speed of the block.
PUSH_STRIDE = 0.06


@dataclass(frozen=True)
class FetchScene:
    """One observation of a Fetch task with an object, by name. Positions (3,) in meters, world frame.

    Attributes:
        grip: position between the fingertips.
        width: distance between the fingers, 0 closed, about 0.1 open, 0.05 around the block.
        block: position of the block's center.
        goal: position where the block shall be.
    """

    grip: Array
    width: float
    block: Array
    goal: Array

    @classmethod
    def from_observation(cls, observation: dict[str, np.ndarray]) -> "FetchScene":
        """Read `agent_pos` (10,) and `environment_state` (18,) of one environment.

        Raises:
            ValueError: if the shapes differ, for instance because the observation is batched.
        """
        agent, scene = state_vectors(observation, 10, 18)
        return cls(grip=agent[:3], width=float(agent[3] + agent[4]), block=scene[:3], goal=scene[-3:])


def move(displacement: Array, gripper: float) -> np.ndarray:
    """Proportional action (4,) in [-1, 1], float32, for a displacement (3,) in meters."""
    return np.clip(np.append(POSITION_GAIN * displacement, gripper), -1.0, 1.0).astype(np.float32)


def fetch_reach_expert(observation: dict[str, np.ndarray]) -> np.ndarray:
    """Go straight to the goal.

    Args:
        observation: `agent_pos` (10,), `environment_state` (3,).

    Returns:
        Action (4,) in [-1, 1], float32.
    """
    agent, goal = state_vectors(observation, 10, 3)
    return move(goal - agent[:3], gripper=0.0)


def fetch_pick_and_place_expert(observation: dict[str, np.ndarray]) -> np.ndarray:
    """Descend onto the block in a funnel, close around it, carry it to the goal.

    The hand keeps a height that falls with the horizontal distance to the block and with the opening of the fingers.
    The fingers close where the block is between them. The motion to the goal fades in as their distance falls to the
    width of the block, and ends if the block is lost.

    Args:
        observation: `agent_pos` (10,), `environment_state` (18,).

    Returns:
        Action (4,) in [-1, 1], float32.
    """
    return pick_and_place(FetchScene.from_observation(observation))


def pick_and_place(scene: FetchScene, approach: Array | None = None) -> np.ndarray:
    """Action of `fetch_pick_and_place_expert`; `approach` is another displacement (3,) onto the block."""
    to_block = scene.block - scene.grip
    between_fingers = ramp(float(np.linalg.norm(to_block)), zero_at=0.035, one_at=0.020)
    held = between_fingers * ramp(scene.width, zero_at=0.058, one_at=0.052)

    fingers_shut = (1.0 - between_fingers) * ramp(scene.width, zero_at=0.09, one_at=0.07)
    if approach is None:
        approach = descend(to_block, GRASP_CLEARANCE, fingers_shut)
    carry = scene.goal - scene.block
    gripper = OPEN + (CLOSE - OPEN) * between_fingers
    return move((1.0 - held) * approach + held * carry, gripper)


def fetch_push_expert(observation: dict[str, np.ndarray]) -> np.ndarray:
    """Go behind the block, seen from the goal, lower the hand there and push until the block rests at the goal.

    The hand stays `PUSH_CLEARANCE` above the block until it is behind it and in line with the goal, and rises again
    if the block slips away to the side. Near the goal all motion fades out.

    Args:
        observation: `agent_pos` (10,), `environment_state` (18,).

    Returns:
        Action (4,) in [-1, 1], float32.
    """
    return push(FetchScene.from_observation(observation))


def push(scene: FetchScene) -> np.ndarray:
    """Action of `fetch_push_expert`."""
    to_goal = scene.goal[:2] - scene.block[:2]
    distance = float(np.linalg.norm(to_goal))
    forward = to_goal / max(distance, 1e-6)
    from_block = scene.grip[:2] - scene.block[:2]
    behind = -float(from_block @ forward)
    sideways = from_block + behind * forward
    above = float(scene.grip[2] - scene.block[2])

    # A hand in the air needs more room to come down than a lowered hand, in contact, needs to stay down.
    room = 0.03 + 0.025 * ramp(above, zero_at=0.02, one_at=0.05)
    is_behind = ramp(behind, zero_at=room - 0.01, one_at=room)
    in_line = is_behind * ramp(float(np.linalg.norm(sideways)), zero_at=0.03, one_at=0.015)
    pushing = in_line * ramp(above, zero_at=0.03, one_at=0.015)
    # Close to the block and still low, rise before moving on: otherwise the hand drags the block along.
    may_travel = max(
        ramp(float(np.linalg.norm(from_block)), zero_at=0.07, one_at=0.11),
        ramp(above, zero_at=0.03, one_at=0.06),
    )

    travel = -PUSH_STANDOFF * forward - from_block
    pushed = min(distance + behind - PUSH_CONTACT, PUSH_STRIDE) * forward - 2.0 * sideways
    horizontal = (1.0 - pushing) * may_travel * travel + pushing * pushed
    vertical = PUSH_CLEARANCE * (1.0 - in_line) - above
    away_from_goal = ramp(distance, zero_at=0.015, one_at=0.03)
    return move(away_from_goal * np.append(horizontal, vertical), gripper=0.0)


EXPERTS: dict[str, Expert] = {
    "FetchReach-v4": Expert(fetch_reach_expert),
    "FetchPush-v4": Expert(fetch_push_expert),
    "FetchPickAndPlace-v4": Expert(fetch_pick_and_place_expert),
}
