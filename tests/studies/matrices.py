"""A small comparison: its YAML, evaluations with known outcomes and reports of rounds."""

from pathlib import Path

import yaml

from lerobot_agpd.studies.evaluation import Evaluation
from lerobot_agpd.studies.matrix import load_matrix

MISSING = object()


def content(tmp_path: Path) -> dict:
    for name in ("teacher", "demos"):
        (tmp_path / name).mkdir(exist_ok=True)
    return {
        "tasks": {
            "pusht": {
                "env": {"type": "pusht", "obs_type": "environment_state_agent_pos"},
                "dataset": {"repo_id": "local/x", "root": str(tmp_path / "demos"), "episodes": [0, 1]},
                "teacher": str(tmp_path / "teacher"),
                "flags": {"steps": 20},
            }
        },
        "methods": {
            "bc": {"teacher": False, "flags": {"policy": {"collect": {"every": 0}, "adversary.weight": 0}}},
            "agpd": {"note": "the whole method"},
            "teacher": {"policy": "{teacher}"},
        },
        "seeds": [1, 2],
        "common": {"steps": 10, "policy": {"type": "agpd", "push_to_hub": False, "collect": {"every": 7}}},
        "evaluation": {"episodes": 4, "curve_episodes": 2},
        "output": str(tmp_path / "out"),
    }


def load(tmp_path: Path, entries: dict):
    path = tmp_path / "matrix.yaml"
    path.write_text(yaml.safe_dump(entries, sort_keys=False))
    return load_matrix(path)


def changed(entries: dict, where: str, value) -> dict:
    *parents, last = where.split(".")
    inner = entries
    for name in parents:
        inner = inner[name]
    inner[last] = value
    if value is MISSING:
        del inner[last]
    return entries


def evaluation(successes, seed=100_000) -> Evaluation:
    return Evaluation(
        successes=[bool(value) for value in successes],
        max_rewards=[0.5 * value for value in map(float, successes)],
        seeds=list(range(seed, seed + len(successes))),
    )


def tally(generated, successful, kept, solved_at_start=0) -> dict:
    return {
        "generated": generated,
        "solved_at_start": solved_at_start,
        "successful": successful,
        "kept": kept,
    }


def collected(strategy, teacher_only, actions=None, states=None, **changes) -> dict:
    """A round's report; generated, successful and kept episodes of both parts, none of them solved at the start."""
    return {
        "round": 0,
        "strength": 0.5,
        "next_strength": 0.5,
        "step": 10,
        "total": tally(*(sum(counts) for counts in zip(strategy, teacher_only, strict=True))),
        "strategy": tally(*strategy),
        "teacher_only": tally(*teacher_only),
        "retried": tally(0, 0, 0),
        "student_alone": tally(0, 0, 0),
        "kept_frames": 0,
        "mean_max_reward": None,
        "mean_discrepancy": None,
        "mean_discrepancy_teacher_only": None,
        "mean_guidance_shift": 0.5,
        "mean_student_steps": None,
        "diagnostics": {"actions": actions, "states": states, "seconds": 0.0} if actions or states else None,
        "seconds": {"teacher": 2.0, "environment": 1.0},
        **changes,
    }
