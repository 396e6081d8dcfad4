#!/usr/bin/env bash
# ALOHA transfer-cube from object poses: scripted demonstrations, a diffusion teacher, a distilled student. Episodes are
# long (50 steps per second, up to 400 steps).
# usage: examples/aloha.sh [output folder]
source "$(dirname "$0")/common.sh"
output=${1:-outputs/transfer_cube}
env=(--env.type=aloha_state --env.task=AlohaTransferCube-v0)
settings "$output"
horizon=(--policy.horizon=32 --policy.n_action_steps=16)      # 0.3 s of executed motion
chunk=(--policy.chunk_size=32 --policy.n_action_steps=16)

record "$output/many" "$MANY" 10000 "${env[@]}"
record "$output/few" "$FEW" 5000 "${env[@]}" --skill="$SKILL"
teacher "$output/teacher" "$output/many" "${horizon[@]}"
cloning "$output/cloning" "$output/few" "${chunk[@]}"
distill "$output/agpd" "$output/few" "$output/teacher" "${env[@]}" "${chunk[@]}"
report "$output" "${env[@]}" --title="ALOHA transfer-cube, $FEW demonstrations"
