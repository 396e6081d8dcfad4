"""Reading the human demonstrations of DAPG (arXiv:1709.10087), made in virtual reality with the Adroit hand.

They come as DAPG's own pickles (`door-v0_demos.pickle` and so on, github.com/aravindr93/hand_dapg): a list with one dict
per episode, of `observations`, `actions`, `rewards` and `init_state_dict`. Or as an .npz file with `observations`,
`actions` and `rewards` of all episodes in a row, `episode_ends`, and one row of `init_<name>` per episode for each array of
the initial state.
"""

import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_agpd.envs.array_pickle import load_arrays
from lerobot_agpd.envs.robotics_tasks import TASKS

Array = np.ndarray

INITIAL_STATES: dict[str, dict[str, int]] = {
    "AdroitHandDoor-v1": {"qpos": 30, "qvel": 30, "door_body_pos": 3},
    "AdroitHandHammer-v1": {"qpos": 33, "qvel": 33, "board_pos": 3},
    "AdroitHandPen-v1": {"qpos": 30, "qvel": 30, "desired_orien": 4},
    "AdroitHandRelocate-v1": {"qpos": 36, "qvel": 36, "obj_pos": 3, "target_pos": 3},
}
"""Arrays, with their lengths, that Gymnasium-Robotics resets each task to; they tell which task a file is of."""

STEP_KEYS = ("observations", "actions", "rewards")
INIT_PREFIX = "init_"


@dataclass(frozen=True)
class Recording:
    """One recorded episode of T steps, as it is in the file.

    Attributes:
        task: key of `robotics_tasks.TASKS`.
        observations: (T, D) as the environment gives them, hand and scene together; before each action.
        actions: (T, A); the environment clips them to [-1, 1].
        rewards: (T,) of the state that an action leads to, by the rewards of that time.
        initial_state: what the environment resets to, `INITIAL_STATES[task]`.
    """

    task: str
    observations: Array
    actions: Array
    rewards: Array
    initial_state: dict[str, Array]

    def __len__(self) -> int:
        return len(self.actions)


def read_recordings(source: Path) -> list[Recording]:
    """Read and check all recordings of a file; all are of one task.

    Raises:
        ValueError: naming the file, and the episode and array that are missing, of a wrong shape or not finite.
    """
    episodes = _split_npz(source) if source.suffix == ".npz" else load_arrays(source)
    if not isinstance(episodes, list) or not episodes:
        found = "an empty list" if episodes == [] else f"a {type(episodes).__name__}"
        raise ValueError(f"{source} must hold a list of episodes, found {found}")
    recordings = [_recording(episode, f"{source}: episode {index}") for index, episode in enumerate(episodes)]
    if len(tasks := sorted({recording.task for recording in recordings})) > 1:
        raise ValueError(f"{source} mixes the tasks {', '.join(tasks)}; expected one")
    return recordings


def _split_npz(path: Path) -> list[dict[str, Any]]:
    """Episodes of an .npz file in the form of DAPG's pickles."""
    arrays = _read_npz(path)
    bounds = _episode_bounds(arrays, path)
    init = {key: values for key, values in arrays.items() if key.startswith(INIT_PREFIX)}
    n_episodes = len(bounds) - 1
    for keys, length in ((STEP_KEYS, bounds[-1]), (init, n_episodes)):
        for key in keys:
            if (n_rows := len(np.atleast_1d(arrays[key]))) != length:
                raise ValueError(
                    f"{path}: {key} has {n_rows} rows, episode_ends has {n_episodes} episodes and {bounds[-1]} rows"
                )
    return [
        {
            **{key: arrays[key][start:end] for key in STEP_KEYS},
            "init_state_dict": {key.removeprefix(INIT_PREFIX): values[row] for key, values in init.items()},
        }
        for row, (start, end) in enumerate(pairwise(bounds))
    ]


def _read_npz(path: Path) -> dict[str, Array]:
    if not zipfile.is_zipfile(path):
        raise ValueError(f"{path} is not an .npz file")
    try:
        with np.load(path) as archive:
            arrays = dict(archive)
    except Exception as error:  # a damaged archive may raise anything
        raise ValueError(f"{path} cannot be read: {error}") from error
    if missing := [key for key in (*STEP_KEYS, "episode_ends") if key not in arrays]:
        raise ValueError(f"{path} has no array {missing}; found {sorted(arrays)}")
    return arrays


def _episode_bounds(arrays: Mapping[str, Array], path: Path) -> list[int]:
    """Rows at which episodes begin, and the number of rows at the end."""
    ends = arrays["episode_ends"]
    if ends.ndim != 1 or ends.dtype.kind not in "iu" or len(ends) == 0:
        raise ValueError(f"{path}: episode_ends must be row numbers, found {ends.dtype} {ends.shape}")
    bounds = [0, *ends.tolist()]
    if any(end <= start for start, end in pairwise(bounds)):
        raise ValueError(f"{path}: episode_ends must rise from episode to episode, found {bounds[1:11]}")
    return bounds


def _recording(episode: Any, where: str) -> Recording:
    """Check one episode of a pickle."""
    required = (*STEP_KEYS, "init_state_dict")
    if not isinstance(episode, Mapping) or not set(required) <= set(episode):
        found = list(episode) if isinstance(episode, Mapping) else f"a {type(episode).__name__}"
        raise ValueError(f"{where} must be a dict with {', '.join(required)}; found {found}")
    state = episode["init_state_dict"]
    names = list(state) if isinstance(state, Mapping) else []
    task = next((task for task, sizes in INITIAL_STATES.items() if set(sizes) <= set(names)), None)
    if task is None:
        raise ValueError(f"{where}: the initial state has {names}, expected one of {_known_states()}")
    actions, spec = episode["actions"], TASKS[task]
    n_steps = len(actions) if isinstance(actions, np.ndarray) and actions.ndim else 0
    if n_steps == 0:
        raise ValueError(f"{where} has no actions")
    shapes: dict[str, tuple[int, ...]] = {
        "observations": (n_steps, len(spec.agent) + len(spec.scene)),
        "actions": (n_steps, spec.action_dim),
        "rewards": (n_steps,),
    }
    return Recording(
        task=task,
        **{key: _checked(episode[key], shape, f"{where}: {key}") for key, shape in shapes.items()},
        initial_state={
            key: _checked(state[key], (size,), f"{where}: initial {key}").astype(np.float64)
            for key, size in INITIAL_STATES[task].items()
        },
    )


def _known_states() -> str:
    return "; ".join(f"{task} ({', '.join(sizes)})" for task, sizes in INITIAL_STATES.items())


def _checked(values: Any, shape: tuple[int, ...], where: str) -> Array:
    """Return an array of numbers that has a shape and is finite."""
    if not isinstance(values, np.ndarray) or values.dtype.kind not in "fiu":
        kind = values.dtype if isinstance(values, np.ndarray) else type(values).__name__
        raise ValueError(f"{where} must be an array of numbers, found {kind}")
    if values.shape != shape:
        raise ValueError(f"{where} has shape {values.shape}, expected {shape}")
    if not (finite := np.isfinite(values)).all():
        raise ValueError(f"{where} is not finite in row {int(np.argwhere(~finite)[0][0])}")
    return values
