"""Faults of data and files: demonstrations, teachers, and what a run has written."""

from pathlib import Path

import damage
from fault import Fault

CLONING = ("--policy.collect.every=0",)
DATA, INFO, STATS = "data/*/*.parquet", "meta/info.json", "meta/stats.json"
MODEL = "checkpoints/000003/pretrained_model/"
STATE = "checkpoints/000003/training_state/"

# ---- demonstrations and teachers ----

NUMBERS = [
    Fault(
        "NaN in a demonstration's state",
        damage.demonstrations(DATA, damage.number("observation.state", float("nan"))),
        "refused",
        ("--dataset", "'observation.state'", "episode 1, frame 2"),
        "accepted; the loss is NaN from the first step, exit 0",
    ),
    Fault(
        "infinity in a demonstration's environment state",
        damage.demonstrations(DATA, damage.number("observation.environment_state", float("inf"))),
        "refused",
        ("--dataset", "'observation.environment_state'", "episode 1, frame 2"),
        "accepted; the loss is NaN from the first step, exit 0",
    ),
    Fault(
        "NaN in a demonstration's action",
        damage.demonstrations(DATA, damage.number("action", float("nan"))),
        "refused",
        ("--dataset", "'action'", "episode 1, frame 2"),
        "refused with a text about processors",
    ),
    Fault(
        "NaN in the demonstrations' statistics",
        damage.demonstrations(STATS, damage.statistic),
        "refused",
        ("--dataset", "'std' of 'observation.state'", "recompute_stats"),
        "accepted; everything is NaN, exit 0",
    ),
    Fault(
        "demonstrations without statistics",
        damage.demonstrations(STATS, damage.remove),
        "refused",
        ("--dataset", "no statistics", "recompute_stats"),
        "trains on values that are not normalized",
    ),
    Fault(
        "demonstrations at 25 Hz, environment at 10",
        damage.demonstrations(INFO, damage.rate),
        "refused",
        ("25 frames per second", "--env.fps) runs at 10"),
        "trains on two time scales",
    ),
    Fault(
        "NaN in a teacher's weights, no collection",
        damage.teacher("model.safetensors", damage.weights, *CLONING),
        "refused",
        ("--policy.teacher.path", "not finite"),
        "exit 0, everything is NaN",
    ),
]

BARE = 'a bare JSONDecodeError, "Cannot reach the Hub" or BadZipFile, without path or remedy'
"""What was said of about twelve kinds of damaged files."""

HOW = {"truncated": damage.truncate, "missing": damage.remove, "a garbled line in": damage.garble}

DEMONSTRATIONS = {
    "info.json": INFO,
    "stats.json": STATS,
    "index of episodes": "meta/episodes/*/*.parquet",
    "frames": DATA,
    "tasks": "meta/tasks.parquet",
}

JOURNAL = {  # file, damage: what the line must say
    ("agpd/journal.json", "truncated"): ("journal.json", "restore"),
    ("agpd/round-00000/rank-0.jsonl", "a garbled line in"): ("rank-0.jsonl", "delete the line"),
    ("agpd/round-00001/report.json", "truncated"): ("report.json", "restore"),
    ("agpd/round-00000/report.json", "missing"): ("round-00000", "restore"),
    ("agpd/round-00000", "missing"): ("round-00000", "restore"),
    ("agpd/round-00000/*.npy", "truncated"): (".npy", "delete the line"),
    ("agpd/round-00000/*.npy", "missing"): (".npy", "delete the line"),
    (MODEL + "agpd_state.json", "truncated"): ("agpd_state.json", "earlier checkpoint"),
    (MODEL + "agpd_state.json", "missing"): ("agpd_state.json", "--policy.path"),
}

CHECKPOINT = {  # files that LeRobot reads: outcome
    MODEL + "model.safetensors": "refused",
    MODEL + "config.json": "refused",
    MODEL + "policy_preprocessor.json": "refused",
    MODEL + "train_config.json": "named",
    STATE + "optimizer_state.safetensors": "refused",
    STATE + "training_step.json": "refused",
}

TEACHER = {
    ("truncated", "config.json"): (damage.truncate, "restore", BARE),
    ("truncated", "model.safetensors"): (damage.truncate, "restore", BARE),
    ("truncated", "policy_preprocessor.json"): (damage.truncate, "restore", BARE),
    ("truncated", "*normalizer*.safetensors"): (damage.truncate, "restore", BARE),
    ("missing", "model.safetensors"): (damage.remove, "is missing", BARE),
    ("pickled", "model.safetensors"): (damage.pickled, "never read", ""),
    ("missing", "policy_preprocessor.json"): (
        damage.remove,
        "migrate_policy_normalization",
        "LeRobot's traceback at the first step",
    ),
    ("a field of another version in", "config.json"): (
        damage.foreign("of_another_version"),
        "another version",
        '"neither a folder with a policy\'s config.json nor a Hub repository"',
    ),
    ("subprocess.Popen in", "policy_postprocessor.json"): (
        damage.program,
        "subprocess.Popen",
        "the program is run",
    ),
}

FILES = [
    *(
        Fault(
            f"demonstrations: {how} {name}",
            damage.demonstrations(pattern, HOW[how]),
            "named",
            ("--dataset.root={demos}", "lerobot-agpd-doctor"),
            BARE,
        )
        for name, pattern in DEMONSTRATIONS.items()
        for how in ("truncated", "missing")
        if (name, how) != ("stats.json", "missing")  # among the numbers
    ),
    *(
        Fault(
            f"teacher: {what} {pattern}",
            damage.teacher(pattern, how),
            "refused",
            ("{teacher}", remedy),
            before,
            afterwards=lambda bench: ["the program was run"] if (bench.teacher / "ran").exists() else [],
        )
        for (what, pattern), (how, remedy, before) in TEACHER.items()
    ),
    *(
        Fault(f"run: {how} {pattern}", damage.run(pattern, HOW[how]), "refused", names, BARE)
        for (pattern, how), names in JOURNAL.items()
    ),
    *(
        Fault(
            f"run: truncated {pattern}",
            damage.run(pattern, damage.truncate),
            outcome,
            (f"{Path(pattern).name} is damaged", "goes on with: lerobot-train", "000006"),
            BARE,
        )
        for pattern, outcome in CHECKPOINT.items()
    ),
]
