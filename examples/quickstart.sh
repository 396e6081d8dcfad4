#!/usr/bin/env bash
# The main job in a few minutes on two CPU cores, offline: clone ten demonstrations of FetchPickAndPlace, distil a
# diffusion teacher into the same student, compare. How the teacher and the demonstrations were made is at the end.
# usage: examples/quickstart.sh [output folder, default outputs/quickstart]
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
output=${1:-outputs/quickstart}
export HF_HUB_OFFLINE=1 OMP_NUM_THREADS=${OMP_NUM_THREADS:-1} MUJOCO_GL=${MUJOCO_GL:-egl}
if [ -e "$output" ]; then
    echo "$output already exists; remove it or name another folder" >&2
    exit 1
fi
mkdir -p "$output"

student=(--config_path="$here/presets/student_cpu.yaml"
    --dataset.repo_id=local/fetch_pick_and_place --dataset.root="$here/quickstart/demonstrations"
    --steps=2000 --save_freq=500 --log_freq=100)
env=(--env.type=gymnasium_robotics --env.task=FetchPickAndPlace-v4)
# LeRobot prints a traceback when FFmpeg's libraries are absent; state-only data needs none. It goes to the logs.
quiet() { "$@" 2> >(tee "$log" | grep --line-buffered -E "round |WARNING.*round|Training: +[0-9]*[05]0?%|End of training|^[A-Za-z]*Error" >&2); }

echo "== 1/4 behaviour cloning of ten demonstrations"
log=$output/cloning.log quiet lerobot-train "${student[@]}" --output_dir="$output/cloning" \
    --policy.collect.every=0 --policy.adversary.weight=0

echo "== 2/4 AGPD: the same student, a diffusion teacher and five collection rounds"
log=$output/agpd.log quiet lerobot-train "${student[@]}" "${env[@]}" --output_dir="$output/agpd" \
    --policy.teacher.path="$here/quickstart/teacher" \
    --policy.collect.warmup=500 --policy.collect.every=250 --policy.collect.rounds=5 --policy.collect.episodes=50

echo "== 3/4 evaluation on 200 seeds that neither training nor collection used"
log=$output/report.log quiet lerobot-agpd-report "${env[@]}" --output="$output" --title="FetchPickAndPlace, 10 demonstrations" \
    --policies="{teacher: $here/quickstart/teacher}" --runs="{cloning: $output/cloning, AGPD student: $output/agpd}" \
    --episodes=200 --curve_episodes=50

echo "== 4/4 a recorded rollout"
log=$output/viz.log quiet lerobot-agpd-viz --policy.path="$output/agpd/checkpoints/last/pretrained_model" "${env[@]}" \
    --render=false --output="$output/rollout.rrd"

echo "table: $output/report.md   picture: $output/curves.png   recording: rerun $output/rollout.rrd"

# Teacher and demonstrations come from the project's own commands:
#   lerobot-agpd-demos --env.type=gymnasium_robotics --env.task=FetchPickAndPlace-v4 --episodes=10 --seed=5000 --root=...
#   lerobot-agpd-demos --env.type=gymnasium_robotics --env.task=FetchPickAndPlace-v4 --episodes=400 --seed=10000 --root=...
#   lerobot-train --config_path=examples/presets/teacher_cpu.yaml --policy.prediction_type=sample --steps=6000 --dataset...
