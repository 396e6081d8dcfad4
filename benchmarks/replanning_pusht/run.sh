#!/usr/bin/env bash
# Reward against the number of steps executed per prediction, for the teacher and three students of the Push-T comparison.
# usage: AGPD_RUNS=folder of the comparison's runs benchmarks/replanning_pusht/run.sh      (about half an hour on one core)
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
export HF_HUB_OFFLINE=1 OMP_NUM_THREADS=${OMP_NUM_THREADS:-1} MUJOCO_GL=${MUJOCO_GL:-egl}
last=checkpoints/last/pretrained_model
student() { echo "$AGPD_RUNS/comparison_pusht/pusht/$1/seed-1000/train/$last"; }
lerobot-agpd-report --env.type=pusht --env.obs_type=environment_state_agent_pos --output="$here" --title="Push-T, 20 demonstrations" \
    --episodes=200 --batch_size=50 --n_action_steps="[8,4,2,1]" \
    --policies="{teacher: $AGPD_RUNS/pusht_teacher/$last, PD: $(student pd), AGPD: $(student agpd), DAgger relabelled: $(student dagger_relabelled)}"
rm "$here"/report.md "$here"/curves.png
