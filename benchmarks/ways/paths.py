"""The paths that the kept episodes of every round took, and those of the student at the end: paths.json and paths.png.

usage: python benchmarks/ways/paths.py $AGPD_RUNS/comparison_point_maze/three_exits pd dagger agpd     (reads finished runs)
       python benchmarks/ways/paths.py                                          (draws paths.png from the committed numbers)
"""

import json
import sys
from pathlib import Path

import numpy as np
import torch
from lerobot.envs.factory import make_env, make_env_pre_post_processors
from lerobot.scripts.lerobot_eval import rollout
from lerobot.utils.constants import OBS_STATE
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from lerobot_agpd.envs.maze_tasks import EXIT, TASKS, WALL
from lerobot_agpd.envs.point_maze import PointMazeWaysEnv
from lerobot_agpd.loading import load_policy
from lerobot_agpd.replay.journal import EpisodeJournal
from lerobot_agpd.studies.evaluation import checkpoint_config, checkpoint_steps

RESULT, PICTURE = Path(__file__).parent / "paths.json", Path(__file__).parent / "paths.png"
TASK, SEED = "ThreeExits-v0", 1000
STUDENT_EPISODES, FIRST_SEED = 50, 100_000
TITLES = {"pd": "PD", "dagger": "DAgger", "guided": "guided", "agpd": "AGPD", "nearest_4": "nearest of 4"}
COLORS = ("tab:blue", "tab:orange", "tab:green")


def centimeters(positions: np.ndarray) -> list[list[int]]:
    """Every second position (T, 2) in whole centimeters, and the last one."""
    return np.rint(100 * np.concatenate([positions[:-1:2], positions[-1:]])).astype(int).tolist()


def kept_paths(root: Path) -> list[list[list[list[int]]]]:
    """Per round and kept episode the ball's path."""
    journal = EpisodeJournal(root)
    return [
        [centimeters(episode.column(OBS_STATE)[:, :2]) for episode in journal.kept(number)]
        for number in range(len(journal.reports()))
    ]


def student_paths(run: Path) -> list[list[list[int]]]:
    """Paths of the last checkpoint's policy from unseen starts."""
    loaded = load_policy(checkpoint_config(list(checkpoint_steps(run).values())[-1], "cpu"))
    config = PointMazeWaysEnv(task=TASK)
    (env,) = make_env(config, n_envs=STUDENT_EPISODES, use_async_envs=False)["point_maze_ways"].values()
    processors = make_env_pre_post_processors(config, loaded.policy.config)
    seeds = list(range(FIRST_SEED, FIRST_SEED + STUDENT_EPISODES))
    with torch.no_grad():
        data = rollout(
            env,
            loaded.policy,
            *processors,
            loaded.preprocessor,
            loaded.postprocessor,
            seeds=seeds,
            return_observations=True,
        )
    states, done = data["observation"][OBS_STATE].numpy(), data["done"].numpy()
    ends = done.argmax(axis=1)  # the observation after it is the next episode's
    return [centimeters(path[: end + 1, :2]) for path, end in zip(states, ends, strict=True)]


def draw_maze(axes: Axes, scale: float = 100.0) -> None:
    """Walls of the task, exits marked, in centimeters."""
    maze = TASKS[TASK].maze
    height, width = len(maze), len(maze[0])
    for i, row in enumerate(maze):
        for j, cell in enumerate(row):
            color = {WALL: "0.75", EXIT: "#ffd9d9"}.get(cell)
            if color:
                corner = (scale * (j - width / 2), scale * (height / 2 - i - 1))
                axes.add_patch(Rectangle(corner, scale, scale, color=color, linewidth=0))
    axes.set(xlim=(-scale * width / 2, scale * width / 2), ylim=(-scale * height / 2, scale * height / 2))
    axes.set_aspect("equal")
    axes.set_xticks([])
    axes.set_yticks([])


def draw(content: dict[str, dict[str, list]]) -> None:
    """One row per method: the kept episodes of every round, and what the student does in the end."""
    n_rounds = max(len(paths["rounds"]) for paths in content.values())
    figure = Figure(figsize=(1.45 * (n_rounds + 1), 2.7 * len(content)), layout="constrained", dpi=150)
    grid = figure.subplots(len(content), n_rounds + 1, squeeze=False)
    spec = TASKS[TASK]
    for row, (method, paths) in zip(grid, content.items(), strict=True):
        for number, (axes, episodes) in enumerate(
            zip(row, [*paths["rounds"], paths["student"]], strict=True)
        ):
            draw_maze(axes)
            last = number == n_rounds
            for path in episodes:
                points = np.array(path)
                # The last recorded state is one step before success, outside of the goal radius of 0.45 m.
                reached = np.linalg.norm(spec.exits - points[-1] / 100, axis=1).min() <= 0.9
                way = spec.way_of(points / 100, points[:, :0])
                color = COLORS[way] if reached else "tab:red"
                axes.plot(*points.T, color=color, linewidth=0.8, alpha=0.5)
            axes.set_title("student" if last else f"round {number}", fontsize=8)
        row[0].set_ylabel(TITLES.get(method, method), fontsize=11)
    figure.savefig(PICTURE)


def main() -> None:
    torch.set_num_threads(1)
    if len(sys.argv) > 1:
        folder, *methods = sys.argv[1:]
        content = {}
        for method in methods:
            run = Path(folder) / method / f"seed-{SEED}" / "train"
            content[method] = {"rounds": kept_paths(run / "agpd"), "student": student_paths(run)}
        RESULT.write_text(json.dumps(content, separators=(",", ":")) + "\n")
    draw(json.loads(RESULT.read_text()))


if __name__ == "__main__":
    main()
