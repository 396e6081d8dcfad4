#!/usr/bin/env bash
# From pixels: a teacher sees the state of FetchPickAndPlace, its student two cameras. From demonstrations to a table. On a
# CPU this takes hours: 1500 steps of one student took half an hour (docs/results/comparison-fetchpick_cameras.md).
# usage: examples/vision.sh [output folder]
FEW=${FEW:-10}
source "$(dirname "$0")/common.sh"
output=${1:-outputs/vision}
teacher=$(dirname "$0")/quickstart/teacher
env=(--env.type=gymnasium_robotics --env.task=FetchPickAndPlace-v4 --env.obs_type=pixels_environment_state_agent_pos
    '--env.cameras=["front","side"]' --env.antialiasing=false)
student=(--config_path="$presets/vision_student_cpu.yaml" --dataset.repo_id=local/vision --dataset.root="$output/few"
    --steps="$STUDENT_STEPS")
settings "$output"

record "$output/few" "$FEW" 5000 "${env[@]}"
train "$output/cloning" "${student[@]}" --policy.collect.every=0 --policy.adversary.weight=0
train "$output/agpd" "${student[@]}" --policy.teacher.path="$teacher" "${env[@]}" \
    --policy.collect.warmup=$((STUDENT_STEPS / 8)) --policy.collect.every=$((STUDENT_STEPS * 3 / 20)) \
    --policy.collect.rounds=5 --policy.collect.episodes="$ROUND_EPISODES"
lerobot-agpd-report --output="$output/report" --episodes="$EVALUATION_EPISODES" "${env[@]}" \
    --policies="{teacher: $teacher}" --runs="{cloning: $output/cloning, AGPD student: $output/agpd}" \
    --title="FetchPickAndPlace from two cameras, $FEW demonstrations"
cat "$output/report/report.md"
