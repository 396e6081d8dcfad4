"""Adaptive Guidance Policy Distillation (AGPD) for LeRobot."""

from importlib.metadata import version

__version__ = version("lerobot_policy_agpd")
