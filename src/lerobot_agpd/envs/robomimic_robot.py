"""Check that a robomimic file was recorded with the robot that `--env.type=robosuite_robomimic` moves.

The same numbers as an action move another controller somewhere else: absolute poses or joint positions, other scales,
another frame of reference or another rate.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from typing import Any

import numpy as np

from lerobot_agpd.envs.robomimic_hdf5 import RobomimicFile
from lerobot_agpd.envs.robomimic_tasks import ARM_CONTROLLER, FPS, ROBOT, RobomimicTask

logger = logging.getLogger(__name__)

CHECKED = ("type", "input_type", "input_ref_frame", "output_max", "output_min")
"""Settings of a controller that decide what an action means."""


def check_robot(file: RobomimicFile, task: RobomimicTask) -> None:
    """Compare robots, control rate and controllers with those of the environment type.

    Raises:
        ValueError: naming what differs.
    """
    kwargs = file.env_args["env_kwargs"]
    robots = kwargs.get("robots", ROBOT)
    robots = [robots] * task.n_robots if isinstance(robots, str) else list(robots)
    expected, differences = [ROBOT] * task.n_robots, []
    if robots != expected:
        differences.append(f"robots {robots} (expected {expected})")
    if file.fps != FPS:
        differences.append(f"control_freq {file.fps} (expected {FPS})")
    controllers = list(_arm_controllers(kwargs.get("controller_configs")))
    if not controllers:
        logger.warning("%s does not name the controller of its actions: OSC_POSE is assumed", file.path)
    for controller in controllers:
        differences += [
            f"controller {key} {controller[key]} (expected {ARM_CONTROLLER[key]})"
            for key in CHECKED
            if key in controller and not _same(controller[key], ARM_CONTROLLER[key])
        ]
    if differences:
        raise ValueError(
            f"{file.path}: its actions would move --env.type=robosuite_robomimic differently: "
            + ", ".join(differences)
        )


def _arm_controllers(config: Any) -> Iterator[dict[str, Any]]:
    """Settings of every arm's controller, in robosuite 1.5's words; one config is for all robots.

    robosuite 1.5 nests them by body part (a Panda's only arm is the right one); 1.4 has them at the top, and says
    `control_delta` for `input_type`.
    """
    for each in filter(None, config if isinstance(config, list) else [config]):
        parts = each.get("body_parts", {"right": each})
        if controller := dict(parts.get("arms", parts).get("right", {})):
            if "control_delta" in controller:
                controller["input_type"] = "delta" if controller["control_delta"] else "absolute"
            yield controller


def _same(value: Any, expected: Any) -> bool:
    """Whether two settings are equal; a number stands for a list of equal ones."""
    if isinstance(expected, list):
        return np.size(value) in (1, len(expected)) and bool(np.allclose(value, expected))
    return bool(value == expected)
