#!/usr/bin/env bash
# Clone ten demonstrations of FetchPickAndPlace, distill a diffusion teacher into the same student, and compare them.
# Offline, some minutes on two CPU cores (longer if they are busy). How the teacher and the demonstrations
# were made is at the end.
# usage: examples/quickstart.sh [output folder, default outputs/quickstart]
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
output=${1:-outputs/quickstart}
export HF_HUB_OFFLINE=1 OMP_NUM_THREADS=${OMP_NUM_THREADS:-1}
if [ -e "$output" ]; then
    echo "$output already exists; remove it or name another folder" >&2
    exit 1
fi
mkdir -p "$output"

student=(--config_path="$here/presets/student_cpu.yaml"
    --dataset.repo_id=local/fetch_pick_and_place --dataset.root="$here/quickstart/demonstrations"
    --steps=3000 --save_freq=1000 --log_freq=250)
env=(--env.type=gymnasium_robotics --env.task=FetchPickAndPlace-v4)

# Show a command's progress and keep all it prints in a log. (Without FFmpeg's libraries LeRobot prints tracebacks at
# every dataset; data without cameras needs none.)
show='step:[0-9.]+K? .*imitation_loss:[0-9.]+|round [0-9]+: .*|evaluated .*'
logged() {
    local log=$output/$1.log
    shift
    if ! "$@" 2>&1 | tee "$log" | stdbuf -oL tr '\r' '\n' | { grep --line-buffered -oE "$show" || true; }; then
        tail -n 30 "$log" >&2
        return 1
    fi
}

# Evaluate policies and runs; what an earlier call has evaluated is not evaluated again.
report() {
    lerobot-agpd-report "${env[@]}" --output="$output" --title="FetchPickAndPlace, 10 demonstrations" \
        --policies="{teacher: $here/quickstart/teacher}" --runs="{$1}" --episodes=200 --curve_episodes=50
}

echo "== 1/4 in the background: behavior cloning of ten demonstrations, its evaluation and the teacher's"
{
    lerobot-train "${student[@]}" --output_dir="$output/cloning" --policy.collect.every=0 --policy.adversary.weight=0 &&
        report "cloning: $output/cloning"
} >"$output/cloning.log" 2>&1 &
cloning=$!

echo "== 2/4 AGPD: the same student, a diffusion teacher, five rounds of 50 episodes"
logged agpd lerobot-train "${student[@]}" "${env[@]}" --output_dir="$output/agpd" \
    --policy.teacher.path="$here/quickstart/teacher" \
    --policy.collect.warmup=500 --policy.collect.every=400 --policy.collect.rounds=5 --policy.collect.episodes=50
trained=$SECONDS
wait $cloning || { tail -n 30 "$output/cloning.log" >&2 && exit 1; }
waited=$SECONDS

echo "== 3/4 in the background: a recorded rollout"
lerobot-agpd-viz --policy.path="$output/agpd/checkpoints/last/pretrained_model" "${env[@]}" \
    --render=false --output="$output/rollout.rrd" --png="$output/rollout.png" >"$output/viz.log" 2>&1 &
viz=$!

echo "== 4/4 evaluation on 200 seeds that neither training nor collection used"
logged report report "cloning: $output/cloning, AGPD student: $output/agpd"
wait $viz || { tail -n 30 "$output/viz.log" >&2 && exit 1; }

echo
cat "$output/report.md"
echo
echo "$SECONDS s: $trained s for AGPD, $((waited - trained)) s more for the background, $((SECONDS - waited)) s for the evaluation"
echo "table $output/report.md, pictures $output/curves.png and $output/rollout.png, recording: rerun $output/rollout.rrd"

# Teacher and demonstrations come from the project's own commands:
#   lerobot-agpd-demos --env.type=gymnasium_robotics --env.task=FetchPickAndPlace-v4 --episodes=10 --seed=5000 --root=...
#   lerobot-agpd-demos --env.type=gymnasium_robotics --env.task=FetchPickAndPlace-v4 --episodes=400 --seed=10000 --root=...
#   lerobot-train --config_path=examples/presets/teacher_cpu.yaml --steps=6000 --dataset.repo_id=... --dataset.root=...
