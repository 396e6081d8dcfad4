"""What the door recordings of DAPG hold, and what their replay does: recordings.json beside this file.

usage: python benchmarks/adroit/recordings.py SOURCE      (a minute on one core)
"""

import json
import sys
from pathlib import Path

import numpy as np
from lerobot.utils.constants import OBS_ENV_STATE, OBS_STATE

from lerobot_agpd.envs.dapg_recordings import read_recordings
from lerobot_agpd.envs.gymnasium_robotics import GymnasiumRoboticsEnv
from lerobot_agpd.envs.replayed_recordings import replay
from lerobot_agpd.envs.robotics_tasks import TASKS

RESULT = Path(__file__).parent / "recordings.json"
HINGE = 28
"""The door's angle in an observation, radians."""
STEPS = (0, 10, 20, 30, 40, 50, 100, 150, 200)


def main(source: str) -> None:
    recordings = read_recordings(Path(source))
    task = recordings[0].task
    env_config = GymnasiumRoboticsEnv(task=task, episode_length=max(map(len, recordings)))
    env = env_config.make_single()
    spec = TASKS[task]
    order = [*spec.agent, *spec.scene]
    episodes, differences = [], []
    for recording in recordings:
        played = replay(env, recording, env_config.features_map)
        shown = np.stack([np.concatenate([f[OBS_STATE], f[OBS_ENV_STATE]]) for f in played.frames])  # (T, D)
        difference = np.abs(shown - recording.observations[:, order])
        differences.append(difference.max(axis=1)[list(STEPS)])
        episodes.append(
            {
                "steps": len(recording),
                "hinge_max_recorded": float(recording.observations[:, HINGE].max()),
                "hinge_max_replayed": float(shown[:, order.index(HINGE)].max()),
                "success_at_any_step": played.success_at_any_step,
                "success_at_last_step": played.success_at_last_step,
                "mean_difference": float(difference.mean()),
            }
        )
    env.close()
    beyond = np.abs(np.concatenate([recording.actions for recording in recordings])) > 1
    result = {
        "source": Path(source).name,
        "task": task,
        "episodes": episodes,
        "actions_beyond_1": float(beyond.mean()),
        "frames_with_an_action_beyond_1": float(beyond.any(axis=1).mean()),
        "largest_difference_by_step": {
            str(step): {"median": float(np.median(column)), "max": float(column.max())}
            for step, column in zip(STEPS, np.transpose(differences), strict=True)
        },
    }
    RESULT.write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
