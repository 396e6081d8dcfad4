"""Recordings of a robomimic file in full precision, kept beside an imported dataset as `meta/robomimic.hdf5`.

It has the file's own schema (see `robomimic_hdf5`) without observations: a raw file in robomimic's words, which its
scripts can replay and extract observations from.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lerobot_agpd.envs.robomimic_hdf5 import RobomimicFile

Array = np.ndarray

RECORDINGS_PATH = Path("meta/robomimic.hdf5")
OBSERVATIONS = {"obs", "next_obs"}


@dataclass(frozen=True)
class Recording:
    """One demonstration as it was recorded, without observations.

    `RobosuiteEnv.reset_to(states[0], model_xml)` puts the simulator where the actions began. Without the
    model a replay of lift ends up millimeters off: robosuite draws the cube's size when it builds a model.

    Attributes:
        demo: its name in the file.
        actions: (T, A) float64.
        rewards: (T,) of the state that an action leads to; None if the file has none.
        dones: (T,); None if the file has none.
        states: (T, S) float64 flattened simulator states, before each action; None if the file has none.
        model_xml: the MuJoCo model; None if the file has none.
    """

    demo: str
    actions: Array
    rewards: Array | None
    dones: Array | None
    states: Array | None
    model_xml: str | None


def copy_recordings(file: RobomimicFile, demos: Iterable[str], path: Path) -> None:
    """Copy everything but the observations to a new file, bit by bit.

    Args:
        file: a robomimic dataset.
        demos: names of the demonstrations to copy.
        path: the new file; its masks are the whole file's, as robomimic's own subsets have them.
    """
    import h5py

    with h5py.File(path, "w") as target:
        data = target.create_group("data")
        data.attrs["env_args"] = file.data.attrs["env_args"]
        for demo in demos:
            source, group = file.data[demo], data.create_group(demo)
            for key in sorted(source.keys() - OBSERVATIONS):
                source.copy(key, group)
            group.attrs.update(source.attrs)
        data.attrs["total"] = sum(int(group.attrs["num_samples"]) for group in data.values())
        for key, names in file.masks.items():
            target[f"mask/{key}"] = np.array(names, dtype="S")


def load_recording(root: Path, demo: str) -> Recording:
    """Load a demonstration as recorded, from the folder of an imported dataset; `meta/robomimic.json` has the names.

    Raises:
        FileNotFoundError: if the dataset was not imported from robomimic.
        KeyError: if it does not hold the demonstration.
    """
    import h5py

    with h5py.File(root / RECORDINGS_PATH, "r") as file:
        group = file["data"][demo]
        return Recording(
            demo,
            actions=group["actions"][()],
            **{key: group[key][()] if key in group else None for key in ("rewards", "dones", "states")},
            model_xml=group.attrs.get("model_file"),
        )
