#!/usr/bin/env bash
# RoboMimic's tasks. lift and can have a scripted expert; for square, transport and tool_hang give robomimic's own data:
#   lerobot-agpd-import-robomimic square/ph/low_dim_v15.hdf5 --root=outputs/square/many
#   lerobot-agpd-import-robomimic square/ph/low_dim_v15.hdf5 --root=outputs/square/few --filter_key=20_percent
# after which this script goes on from them. lift takes an hour or two on one CPU core: robosuite makes 60 steps a second.
# usage: examples/robomimic.sh [task, default lift] [output folder]
source "$(dirname "$0")/common.sh"
task=${1:-lift}
output=${2:-outputs/$task}
env=(--env.type=robosuite_robomimic --env.task="$task")
settings "$output"

record "$output/many" "$MANY" 10000 "${env[@]}"
record "$output/few" "$FEW" 5000 "${env[@]}" --skill="$SKILL"
teacher "$output/teacher" "$output/many"
cloning "$output/cloning" "$output/few"
distill "$output/agpd" "$output/few" "$output/teacher" "${env[@]}"
report "$output" "${env[@]}" --title="$task, $FEW demonstrations"
