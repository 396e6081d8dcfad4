"""Discovery shim: LeRobot imports distributions named `lerobot_policy_*` by their own name."""

import lerobot_agpd.plugin  # noqa: F401
