"""Recordings of a robomimic file in full precision, kept beside an imported dataset as `meta/robomimic.hdf5`.

It has the file's own schema (see `robomimic_hdf5`) without observations: a raw file in robomimic's words, which its
scripts can replay and extract observations from, and which `RobomimicFile` reads.
"""

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from lerobot_agpd.envs.robomimic_hdf5 import RobomimicFile

RECORDINGS_PATH = Path("meta/robomimic.hdf5")
OBSERVATIONS = {"obs", "next_obs"}


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
