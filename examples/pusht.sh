#!/usr/bin/env bash
# Push-T from the human demonstrations of Diffusion Policy: import, teacher, distilled student. On one CPU core a teacher
# worth the name takes hours (TEACHER_STEPS=26000 reached 0.55 success, docs/results/pusht_teacher.md).
# usage: examples/pusht.sh SOURCE [output folder]
# SOURCE: Diffusion Policy's replay buffer, a zarr folder, a zip file of it, or an .npz file with the same arrays.
TEACHER_STEPS=${TEACHER_STEPS:-26000} STUDENT_STEPS=${STUDENT_STEPS:-16000}
source "$(dirname "$0")/common.sh"
source_data=${1:?usage: examples/pusht.sh SOURCE [output folder]}
output=${2:-outputs/pusht}
env=(--env.type=pusht --env.obs_type=environment_state_agent_pos)
settings "$output"

[ -d "$output/many" ] || lerobot-agpd-import-pusht --source="$source_data" --root="$output/many"
[ -d "$output/few" ] || lerobot-agpd-import-pusht --source="$source_data" --root="$output/few" --first_episodes="$FEW"
teacher "$output/teacher" "$output/many" --policy.mlp.width=640 --policy.mlp.n_blocks=4 --policy.optimizer_lr=5e-4
cloning "$output/cloning" "$output/few"
# Success is coverage above 0.95, reward 1. Here an episode is kept from a reward of 0.9 on.
distill "$output/agpd" "$output/few" "$output/teacher" "${env[@]}" --policy.collect.min_reward=0.9
report "$output" "${env[@]}" --title="Push-T, $FEW demonstrations"
