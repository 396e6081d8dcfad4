"""Makes files in the schema of robomimic's own scripts: of random numbers, or of real rollouts of robosuite's lift."""

import json
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from lerobot_agpd.cli.import_robomimic import ImportRobomimicConfig, import_robomimic

LENGTHS = (8, 7, 6, 5)
"""Steps of the demonstrations that the tests share; the first two succeed."""

OBSERVED = {
    "robot0_eef_pos": 3,
    "robot0_eef_quat": 4,
    "robot0_gripper_qpos": 2,
    "robot0_joint_pos": 7,
    "object": 10,
}

OSC_POSE = {
    "type": "OSC_POSE",
    "input_max": 1,
    "input_min": -1,
    "output_max": [0.05, 0.05, 0.05, 0.5, 0.5, 0.5],
    "output_min": [-0.05, -0.05, -0.05, -0.5, -0.5, -0.5],
    "kp": 150,
    "impedance_mode": "fixed",
    "kp_limits": [0, 300],
    "position_limits": None,
    "orientation_limits": None,
    "uncouple_pos_ori": True,
    "interpolation": None,
    "ramp_ratio": 0.2,
}
V141 = {**OSC_POSE, "damping": 1, "damping_limits": [0, 10], "control_delta": True}
RIGHT_ARM = {
    **OSC_POSE,
    "damping_ratio": 1,
    "damping_ratio_limits": [0, 10],
    "input_type": "delta",
    "input_ref_frame": "world",
    "gripper": {"type": "GRIP"},
}
V15 = {"type": "BASIC", "body_parts": {"right": RIGHT_ARM}}
KWARGS = {
    "has_renderer": False,
    "has_offscreen_renderer": False,
    "ignore_done": True,
    "use_object_obs": True,
    "use_camera_obs": False,
    "control_freq": 20,
    "reward_shaping": False,
    "robots": ["Panda"],
    "lite_physics": False,
}
ENV_ARGS = {
    "1.5.1": {
        "env_name": "Lift",
        "env_version": "1.5.1",
        "type": 1,
        "env_kwargs": {**KWARGS, "controller_configs": V15},
    },
    "1.4.1": {
        "env_name": "Lift",
        "env_version": "1.4.1",
        "type": 1,
        "env_kwargs": {**KWARGS, "controller_configs": V141},
    },
}


@dataclass
class Rollout:
    """Arrays of one demonstration, as `data/demo_N` holds them, and its attributes."""

    arrays: dict[str, np.ndarray]
    obs: dict[str, np.ndarray]
    next_obs: dict[str, np.ndarray]
    attributes: dict[str, str]


def random_rollout(seed: int, length: int, success: bool, cameras: tuple[str, ...] = ()) -> Rollout:
    """A demonstration of lift with random numbers, and images of 64 pixels."""
    rng = np.random.default_rng(seed)
    observed = {key: rng.normal(size=(length + 1, dim)) for key, dim in OBSERVED.items()}
    observed["object"][:, 7:] = observed["object"][:, :3] - observed["robot0_eef_pos"]  # from hand to cube
    images = (length + 1, 64, 64, 3)
    observed |= {f"{camera}_image": rng.integers(0, 256, images, dtype=np.uint8) for camera in cameras}
    is_last = np.arange(length) == length - 1
    arrays = {"actions": rng.uniform(-1, 1, (length, 7)), "states": rng.normal(size=(length, 32))}
    arrays |= {"rewards": 1.0 * (is_last & success), "dones": is_last.astype(int)}
    return Rollout(
        arrays,
        obs={key: values[:-1] for key, values in observed.items()},
        next_obs={key: values[1:] for key, values in observed.items()},
        attributes={"model_file": f'<mujoco model="{seed}"/>', "ep_meta": "{}"},
    )


def make_lift():
    import robosuite

    return robosuite.make("Lift", **ENV_ARGS["1.5.1"]["env_kwargs"])


def observe(env) -> dict[str, np.ndarray]:
    """Observations under robomimic's names: the arm's and `object`."""
    raw = env._get_observations(force_update=True)
    arm = {key: raw[key] for key in raw if key.startswith("robot0_") and not key.endswith("-state")}
    return {key: np.array(value) for key, value in (arm | {"object": raw["object-state"]}).items()}


def reach_grasp_lift(obs: dict[str, np.ndarray], step: int, rng: np.random.Generator) -> np.ndarray:
    """Action of a scripted arm that trembles a little and lifts the cube in some 45 steps."""
    action = rng.normal(0, 0.01, 7)
    action[6] = 1.0 if step >= 26 else -1.0
    if step < 26:
        to_cube = obs["object"][:3] - obs["robot0_eef_pos"]
        to_cube[2] += 0.08 if np.linalg.norm(to_cube[:2]) > 0.015 else 0.0
        action[:3] += to_cube / 0.05
    elif step >= 32:
        action[2] += 0.6
    return np.clip(action, -1, 1)


def record(env, seed: int, n_steps: int) -> Rollout:
    """Play one demonstration; the arm's noise and robosuite's start follow from the seed."""
    global_state = np.random.get_state()
    np.random.seed(seed)
    env.reset()
    np.random.set_state(global_state)
    rng = np.random.default_rng(seed)
    attributes = {"model_file": env.sim.model.get_xml(), "ep_meta": json.dumps(env.get_ep_meta())}
    arrays = {"actions": [], "states": [], "rewards": [], "dones": []}
    seen = [observe(env)]
    for step in range(n_steps):
        action = reach_grasp_lift(seen[-1], step, rng)
        arrays["states"].append(env.sim.get_state().flatten())
        _, reward, _, _ = env.step(action)
        seen.append(observe(env))
        arrays["actions"].append(action)
        arrays["rewards"].append(reward)
        arrays["dones"].append(int(env._check_success() or step == n_steps - 1))  # robomimic's done mode 2
    obs = {key: np.stack([shown[key] for shown in seen]) for key in seen[0]}
    return Rollout(
        arrays={key: np.array(values) for key, values in arrays.items()},
        obs={key: values[:-1] for key, values in obs.items()},
        next_obs={key: values[1:] for key, values in obs.items()},
        attributes=attributes,
    )


def write(
    path: Path,
    rollouts: list[Rollout],
    version: str = "1.5.1",
    masks: dict[str, list[str]] | None = None,
    observations: bool = True,
    names: list[str] | None = None,
) -> Path:
    """Write rollouts as robomimic's `dataset_states_to_obs.py` does."""
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        for name, rollout in zip(names or [f"demo_{i}" for i in range(len(rollouts))], rollouts, strict=True):
            group = data.create_group(name)
            for key, values in rollout.arrays.items():
                if observations or key in ("actions", "states"):
                    group.create_dataset(key, data=values)
            for folder, arrays in (("obs", rollout.obs), ("next_obs", rollout.next_obs)) * observations:
                for key, values in arrays.items():
                    group.create_dataset(f"{folder}/{key}", data=values)
            group.attrs.update({**rollout.attributes, "num_samples": len(rollout.arrays["actions"])})
        data.attrs["total"] = sum(len(rollout.arrays["actions"]) for rollout in rollouts)
        data.attrs["env_args"] = json.dumps(ENV_ARGS[version], indent=4)
        for key, demos in (masks or {}).items():
            file.create_dataset(f"mask/{key}", data=np.array(demos, dtype="S"))
    return path


def part(rollout: Rollout, start: int = 0, stop: int = 3) -> Rollout:
    """Some steps of a rollout."""
    parts = [
        {key: values[start:stop] for key, values in arrays.items()}
        for arrays in (rollout.arrays, rollout.obs, rollout.next_obs)
    ]
    return Rollout(*parts, rollout.attributes)


def run_import(source: Path, root: Path, **options) -> LeRobotDataset:
    """Import a file as the command does."""
    return import_robomimic(ImportRobomimicConfig(source=source, root=root, **options))


def column(dataset: LeRobotDataset, key: str, episode: int) -> np.ndarray:
    """What an imported dataset holds of one episode."""
    rows = dataset.hf_dataset.with_format("numpy")[:]
    return np.stack(rows[key])[rows["episode_index"] == episode]
