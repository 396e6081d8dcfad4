#!/usr/bin/env bash
# Fetch: scripted demonstrations, a diffusion teacher, a distilled student.
# usage: examples/fetch.sh [task, default FetchPickAndPlace-v4] [output folder]
# With demonstrations of operators of mixed skill (the low-quality setting) for the student:
#   SKILL="[1,0.75,0.5,0.25]" examples/fetch.sh FetchPush-v4 outputs/mixture
source "$(dirname "$0")/common.sh"
task=${1:-FetchPickAndPlace-v4}
output=${2:-outputs/$task}
env=(--env.type=gymnasium_robotics --env.task="$task")
settings "$output"

record "$output/many" "$MANY" 10000 "${env[@]}"
slow=()
[ "$SKILL" = 1 ] || slow=(--env.episode_length=100) # the less skilled ones need longer
record "$output/few" "$FEW" 5000 "${env[@]}" "${slow[@]}" --skill="$SKILL"
teacher "$output/teacher" "$output/many"
cloning "$output/cloning" "$output/few"
distill "$output/agpd" "$output/few" "$output/teacher" "${env[@]}"
report "$output" "${env[@]}" --title="$task, $FEW demonstrations"
