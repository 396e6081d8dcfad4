#!/usr/bin/env bash
# Success against the number of steps executed per prediction, for the teacher and three students of the FetchPush comparison.
# usage: AGPD_RUNS=folder of the comparison's runs benchmarks/replanning/run.sh      (about 20 minutes on one core)
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
export HF_HUB_OFFLINE=1 OMP_NUM_THREADS=${OMP_NUM_THREADS:-1} MUJOCO_GL=${MUJOCO_GL:-egl}
last=checkpoints/last/pretrained_model
student() { echo "$AGPD_RUNS/comparison_fetchpush/fetchpush/$1/seed-1000/train/$last"; }
lerobot-agpd-report --env.type=gymnasium_robotics --env.task=FetchPush-v4 --output="$here" --title="FetchPush, 20 demonstrations" \
    --episodes=500 --batch_size=50 --n_action_steps="[8,4,2,1]" \
    --policies="{teacher: $AGPD_RUNS/fetchpush_teacher/$last, cloning: $(student bc), PD: $(student pd), AGPD: $(student agpd)}"
rm "$here"/report.md "$here"/curves.png
