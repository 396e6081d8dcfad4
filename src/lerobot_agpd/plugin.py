"""Registers everything this plugin adds to LeRobot: policy types and environment types."""

import multiprocessing

import lerobot_agpd.envs.aloha
import lerobot_agpd.envs.gymnasium_robotics
import lerobot_agpd.envs.robomimic
import lerobot_agpd.policies.act_diffusion.configuration_act_diffusion
import lerobot_agpd.policies.agpd.configuration_agpd
import lerobot_agpd.policies.agpd_diffusion.configuration_agpd_diffusion
import lerobot_agpd.policies.diffusion_transformer.configuration_diffusion_transformer  # noqa: F401

FORKSERVER_PRELOAD = ["lerobot_agpd.envs.workers", "lerobot_agpd.plugin", "gymnasium_robotics"]
"""Imported once, by the forkserver that starts LeRobot's environment workers, instead of by every worker: most of
a worker's start is LeRobot's imports. What is not installed is skipped."""

multiprocessing.set_forkserver_preload(FORKSERVER_PRELOAD)
