"""Registers everything this plugin adds to LeRobot: policy types and environment types."""

import multiprocessing

import lerobot_agpd.envs.gymnasium_robotics
import lerobot_agpd.policies.agpd.configuration_agpd
import lerobot_agpd.policies.diffusion_transformer.configuration_diffusion_transformer  # noqa: F401

FORKSERVER_PRELOAD = ["gym_pusht", "gym_aloha", "gymnasium_robotics"]
"""Packages whose import registers gymnasium environments. LeRobot's asynchronous vector environments start
their workers from a forkserver, which without this knows none of them (those not installed are skipped)."""

multiprocessing.set_forkserver_preload(FORKSERVER_PRELOAD)
