"""Collection rounds: ours, guided; LeRobot's rollout of the same teacher with recording; the environments alone."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from gymnasium.vector import VectorEnv
from lerobot.configs import PreTrainedConfig
from lerobot.envs import make_env, make_env_pre_post_processors
from lerobot.envs.utils import NEW_ROLLOUT_OPTION
from lerobot.policies import get_policy_class, make_pre_post_processors
from lerobot.scripts.lerobot_eval import rollout
from loops import PICK_AND_PLACE, Loop, train_config
from timing import Row, in_turn
from training import ENV, TEACHER

EPISODES, TURNS = 16, 5
MANY, N_ENVS, FEW_TURNS = 32, (1, 8, 32), 2


def rounds(device: str) -> dict[str, Row]:
    """Rounds of 16 episodes in as many environments, and of 32 episodes in fewer and more."""
    collecting = collected(device, EPISODES, EPISODES)
    actions = recorded_actions(collecting)
    envs = vector_env(collecting, EPISODES)
    row = in_turn(
        {
            "environments alone": lambda: play(envs, actions),
            "LeRobot's rollout, recording": lerobots_rollout(collecting, envs),
            "guided round": collecting.policy.agpd.grow,
        },
        TURNS,
    )
    envs.close()
    kept = collecting.policy.agpd.reports[1:]
    frames = {
        "environments alone": EPISODES * actions.shape[1],
        "LeRobot's rollout, recording": EPISODES * actions.shape[1],
        "guided round": float(np.mean([report.kept_frames for report in kept])),
    }
    for name, values in row.items():
        values["frames_per_s"] = frames[name] / values["cpu_ms"] * 1e3
    many = {n_envs: collected(device, MANY, n_envs) for n_envs in N_ENVS}
    grow = {f"guided round of {MANY}, {n} environments": loop.policy.agpd.grow for n, loop in many.items()}
    return row | in_turn(grow, FEW_TURNS, warmup=0) | parts(kept)


def collected(device: str, episodes: int, n_envs: int) -> Loop:
    """A run that has collected a round."""
    sizes = (f"--policy.collect.episodes={episodes}", f"--policy.collect.n_envs={n_envs}")
    loop = Loop(train_config(f"--policy.device={device}", TEACHER, *ENV, *sizes, preset="student_cpu"))
    loop.step()
    loop.policy.agpd.grow()
    return loop


def parts(reports: list) -> dict[str, Row]:
    """Where the rounds' wall time goes, by their own stopwatch."""
    names = sorted({name for report in reports for name in report.seconds})
    seconds = {name: np.median([report.seconds.get(name, 0.0) for report in reports]) for name in names}
    measured = [report.diagnostics.seconds for report in reports if report.diagnostics]
    seconds |= {"diagnostics": np.median(measured)} if measured else {}
    return {f"of a guided round: {name}": {"wall_ms": 1e3 * float(value)} for name, value in seconds.items()}


def recorded_actions(loop: Loop) -> np.ndarray:
    """Actions (E, T, A) of kept episodes, repeated to as many as there are environments."""
    kept = [np.array(episode.column("action")) for _, episode in loop.policy.agpd.journal.stored()]
    return np.stack([kept[number % len(kept)] for number in range(EPISODES)])


def vector_env(loop: Loop, n_envs: int) -> VectorEnv:
    [[envs]] = [suite.values() for suite in make_env(loop.config.env, n_envs=n_envs).values()]
    return envs


def play(envs: VectorEnv, actions: np.ndarray) -> None:
    """Reset, and execute recorded actions."""
    envs.reset(seed=list(range(1_000_000, 1_000_000 + len(actions))), options={NEW_ROLLOUT_OPTION: True})
    for step in range(actions.shape[1]):
        envs.step(actions[:, step])


def lerobots_rollout(loop: Loop, envs: VectorEnv) -> Callable[[], None]:
    """LeRobot's batched rollout of the teacher, every frame written to datasets."""
    config = PreTrainedConfig.from_pretrained(PICK_AND_PLACE / "teacher")
    config.device = loop.config.policy.device
    policy = get_policy_class(config.type).from_pretrained(PICK_AND_PLACE / "teacher", config=config).eval()
    processors = make_pre_post_processors(config, pretrained_path=str(PICK_AND_PLACE / "teacher"))
    env_processors = make_env_pre_post_processors(loop.config.env, config)

    def run() -> None:
        folder = Path(tempfile.mkdtemp())
        rollout(
            envs,
            policy,
            *env_processors,
            *processors,
            seeds=list(range(1_000_000, 1_000_000 + envs.num_envs)),
            recording_dir=folder,
            env_features=loop.config.env.features,
        )
        shutil.rmtree(folder)

    return run
