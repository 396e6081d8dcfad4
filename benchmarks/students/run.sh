#!/usr/bin/env bash
# Other teachers and students on FetchPush, 20 demonstrations: an ACT-DP teacher with an ACT student, and a DP-T that teaches
# itself. About 40 minutes on one CPU core. Steps that are finished are skipped.
# usage: benchmarks/students/run.sh OUTPUT_DIR [DEMOS_20 DEMOS_300]     (recorded here if not given)
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
presets=$here/../../examples/presets
output=$1
few=${2:-$output/fetchpush20} many=${3:-$output/fetchpush300}
export HF_HUB_OFFLINE=1 OMP_NUM_THREADS=${OMP_NUM_THREADS:-1} MUJOCO_GL=${MUJOCO_GL:-egl}
env=(--env.type=gymnasium_robotics --env.task=FetchPush-v4)
rounds=(--policy.collect.warmup=500 --policy.collect.every=600 --policy.collect.rounds=5 --policy.collect.episodes=50
    --policy.collect.n_envs=25 --policy.guidance.scale=0.5)
alone=(--policy.collect.every=0 --policy.adversary.weight=0)
mkdir -p "$output"
[ -d "$few" ] || lerobot-agpd-demos "${env[@]}" --episodes=20 --seed=5000 --root="$few"
[ -d "$many" ] || lerobot-agpd-demos "${env[@]}" --episodes=300 --seed=10000 --root="$many"

# train NAME DATASET PRESET STEPS [more flags]
train() {
    local name=$1 data=$2 preset=$3 steps=$4
    shift 4
    [ -d "$output/$name/checkpoints/$(printf %06d "$steps")" ] && return
    rm -rf "${output:?}/$name"
    lerobot-train --config_path="$presets/$preset.yaml" --dataset.repo_id=local/fetchpush --dataset.root="$data" \
        --steps="$steps" --save_freq=1000 --log_freq=200 --seed=1000 --output_dir="$output/$name" "$@"
}

train act_dp "$many" act_diffusion_cpu 6000
train act_cloning "$few" student_cpu 4000 "${alone[@]}"
train act_student "$few" student_cpu 4000 "${rounds[@]}" "${env[@]}" \
    --policy.teacher.path="$output/act_dp/checkpoints/last/pretrained_model"
train dp_t_cloning "$few" self_distill_cpu 4000 "${alone[@]}"
train dp_t_self "$few" self_distill_cpu 4000 "${rounds[@]}" "${env[@]}"

lerobot-agpd-report "${env[@]}" --output="$output/report" --title="FetchPush, 20 demonstrations" --episodes=300 \
    --policies="{ACT-DP teacher: $output/act_dp/checkpoints/last/pretrained_model}" \
    --runs="{ACT cloning: $output/act_cloning, ACT student of ACT-DP: $output/act_student, \
DP-T cloning: $output/dp_t_cloning, DP-T self-distilled: $output/dp_t_self}"
