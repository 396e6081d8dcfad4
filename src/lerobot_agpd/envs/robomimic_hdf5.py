"""Reading robomimic's HDF5 datasets (Mandlekar et al., arXiv:2108.03298).

The schema, from https://robomimic.github.io/docs/datasets/overview.html (section Dataset Structure):

    data                        attributes: total, env_args (JSON: env_name, env_version, type, env_kwargs)
        demo_0                  attributes: num_samples, model_file (MuJoCo XML); from robosuite 1.5 on ep_meta
            actions  (T, A)     float64, in [-1, 1]
            states   (T, S)     float64, flattened MuJoCo states: time, positions, velocities
            rewards  (T,)       of the state that the action leads to
            dones    (T,)       1 where that state is a success or the demonstration ends, as its maker chose
            obs/<key>           (T, ...), images (T, H, W, 3) uint8; next_obs/<key> alike
    mask
        <filter key>            names of demonstrations, as bytes

The files for robosuite 1.4.1 (`*_v141.hdf5`) and 1.5 (`*_v15.hdf5`) share it; `env_args` tells them apart by
`env_version` and by `controller_configs`, which 1.5 nests by body part. Downloads named `demo*.hdf5` hold no obs.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_agpd.envs.packages import require_packages

Array = np.ndarray

OPERATOR_MASK = re.compile(r"(better|okay|worse)_operator_\d+")
"""Masks of the multi-human files that name who demonstrated; they have no overlap and derived ones a suffix."""

NO_OBSERVATIONS = (
    "it holds simulator states only. Extract observations first with robomimic's script: python -m "
    "robomimic.scripts.dataset_states_to_obs --dataset {path} --output_name low_dim.hdf5 --done_mode 2 (for images "
    "add --camera_names agentview robot0_eye_in_hand --camera_height 84 --camera_width 84)"
)


class RobomimicFile(AbstractContextManager["RobomimicFile"]):
    """A robomimic dataset, open for reading.

    Attributes:
        path: the file.
        data: its group of demonstrations.
        env_args: how its makers built the environment.
        demos: names of all demonstrations, demo_2 before demo_10.
        masks: names of the demonstrations under every filter key.
        fps: control steps per second.
        full_reward: reward of a success; robosuite's five tasks never give as much without one, shaped or not.
    """

    def __init__(self, path: Path):
        """Open the file.

        Raises:
            ValueError: if it is not HDF5, damaged, or not robomimic's.
            ModuleNotFoundError: if h5py is not installed.
        """
        require_packages(["h5py"], f"{path}, an HDF5 file,", extra="robomimic")
        import h5py

        self.path = path
        try:
            self._file = h5py.File(path, "r")
        except OSError as error:
            kind = "truncated or damaged" if h5py.is_hdf5(path) else "not an HDF5 file"
            raise ValueError(f"{path} is {kind}: {error}") from error
        self.env_args = self._env_args()
        self.data = self._file["data"]
        self.fps = int(self._positive("control_freq"))
        self.full_reward = self._positive("reward_scale", default=1.0)
        self.demos = sorted(
            (name for name in self.data if re.fullmatch(r"demo_\d+", name)),
            key=lambda name: int(name.removeprefix("demo_")),
        )
        if not self.demos:
            raise ValueError(f"{path} holds no demonstrations: expected groups data/demo_0, data/demo_1, ...")
        masks = self._file.get("mask", {})
        self.masks = {key: [name.decode() for name in masks[key][()]] for key in sorted(masks)}

    def __exit__(self, *error: object) -> None:
        self._file.close()

    def _env_args(self) -> dict[str, Any]:
        data = self._file.get("data")
        if data is None or "env_args" not in data.attrs:
            found = f"'data' with attributes {sorted(data.attrs)}" if data is not None else sorted(self._file)
            raise ValueError(
                f"{self.path} is no robomimic dataset: expected a group 'data' with the attribute env_args; found "
                f"{found}"
            )
        try:
            env_args = json.loads(data.attrs["env_args"])
        except json.JSONDecodeError as error:
            raise ValueError(f"{self.path}: data's attribute env_args is no JSON: {error}") from error
        missing = [key for key in ("env_name", "env_kwargs") if key not in env_args]
        if missing:
            raise ValueError(f"{self.path}: env_args has no {missing}; found {sorted(env_args)}")
        return env_args

    def _positive(self, key: str, default: float | None = None) -> float:
        value = self.env_args["env_kwargs"].get(key, default)
        if not isinstance(value, int | float) or value <= 0:
            raise ValueError(f"{self.path}: env_kwargs.{key} must be a positive number, found {value}")
        return float(value)

    @property
    def is_v15(self) -> bool:
        """Whether robosuite 1.5 or later made it; in files without `env_version` nested controllers tell."""
        version = self.env_args.get("env_version")
        if version is None:
            return "body_parts" in self.env_args["env_kwargs"].get("controller_configs", {})
        return tuple(map(int, re.findall(r"\d+", version)[:2])) >= (1, 5)

    @property
    def operators(self) -> list[str]:
        """Masks that name one operator each; empty unless several people demonstrated."""
        return [key for key in self.masks if OPERATOR_MASK.fullmatch(key)]

    def operator_of(self, demo: str) -> int:
        """Index into `operators`; -1 if no mask names this demonstration."""
        return next((i for i, key in enumerate(self.operators) if demo in self.masks[key]), -1)

    def select(self, episodes: Sequence[int] | None, filter_key: str | None) -> list[str]:
        """Names of the requested demonstrations, by position or by mask; all if neither is given.

        Raises:
            ValueError: naming the flag, if the file has no such demonstration or mask.
        """
        if filter_key is not None:
            chosen = set(self.masks.get(filter_key, ()))
            problem = None
            if filter_key not in self.masks:
                problem = f"{self.path} has the masks {list(self.masks) or 'none'}"
            elif absent := sorted(chosen - set(self.demos)):
                problem = f"this mask names {absent}, which {self.path} does not hold"
            elif not chosen:
                problem = f"this mask of {self.path} selects no demonstration"
            if problem:
                raise ValueError(f"--filter_key={filter_key}: {problem}")
            return [demo for demo in self.demos if demo in chosen]
        n_demos = len(self.demos)
        outside = [episode for episode in episodes or () if not 0 <= episode < n_demos]
        if outside:
            raise ValueError(
                f"--episodes={outside}: {self.path} has {n_demos} demonstrations, 0 to {n_demos - 1}"
            )
        return self.demos if episodes is None else [self.demos[episode] for episode in episodes]

    def observation_shapes(self, demo: str) -> dict[str, tuple[int, ...]]:
        """Shape of one step of every observation of a demonstration.

        Raises:
            ValueError: if it holds none.
        """
        group = self.data[demo].get("obs")
        if not group:
            raise ValueError(f"{self.path}: {demo} has no obs; {NO_OBSERVATIONS.format(path=self.path)}")
        return {key: tuple(group[key].shape[1:]) for key in sorted(group)}

    def check(self, demos: Iterable[str], shapes: Mapping[str, tuple[int, ...]]) -> None:
        """Check shapes before anything is read; the values are checked by `read`.

        Args:
            demos: the demonstrations to check.
            shapes: shape of one step of every array needed, such as `actions` or `obs/object`.

        Raises:
            ValueError: naming the demonstration and what was expected, if an array is missing or has another shape.
        """
        for demo in demos:
            group, length = self.data[demo], self.length(demo)
            observations = self.observation_shapes(demo)
            for key, shape in shapes.items():
                if key not in group:
                    raise ValueError(
                        f"{self.path}: {demo} has no {key}; found {sorted(set(group) - {'obs', 'next_obs'})} and obs "
                        f"{list(observations)}"
                    )
                if group[key].shape != (length, *shape):
                    raise ValueError(
                        f"{self.path}: {demo}/{key} has shape {group[key].shape}, expected {(length, *shape)}"
                    )
            if "states" in group and len(group["states"]) != length:
                raise ValueError(
                    f"{self.path}: {demo}/states has {len(group['states'])} rows, expected {length}"
                )

    def length(self, demo: str) -> int:
        """Number of steps of a demonstration, as its attribute `num_samples` says.

        Raises:
            ValueError: if it has no such attribute or no steps.
        """
        length = int(self.data[demo].attrs.get("num_samples", 0))
        if length < 1:
            raise ValueError(f"{self.path}: {demo} has no attribute num_samples >= 1")
        return length

    def read(self, demo: str, key: str) -> Array:
        """Read one array of a demonstration, unchanged.

        Raises:
            ValueError: if it is damaged or holds numbers that float32 cannot.
        """
        try:
            values = np.asarray(self.data[demo][key][()])
        except (OSError, RuntimeError) as error:
            raise ValueError(f"{self.path} is damaged: {demo}/{key} cannot be read: {error}") from error
        if values.dtype.kind == "f":
            with np.errstate(over="ignore"):
                finite = np.isfinite(values.astype(np.float32)).reshape(len(values), -1).all(axis=1)
            if not finite.all():
                raise ValueError(
                    f"{self.path}: {demo}/{key} is not finite in float32 at step {int(np.argmin(finite))}"
                )
        return values

    def model_xml(self, demo: str) -> str | None:
        """MuJoCo model of a demonstration; None if the file has none.

        `RobosuiteEnv.reset_to(file.read(demo, "states")[0], file.model_xml(demo))` puts the simulator where the actions
        began. Without the model a replay of lift ends up millimeters off: robosuite draws the cube's size when it builds
        a model.
        """
        model: str | None = self.data[demo].attrs.get("model_file")
        return model

    def is_replayable(self, demo: str) -> bool:
        """Whether a demonstration has simulator states and the model that they belong to."""
        return "states" in self.data[demo] and self.model_xml(demo) is not None


def sha256(path: Path) -> str:
    """Hexadecimal SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
