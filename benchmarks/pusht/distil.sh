#!/usr/bin/env bash
# Cloning of 20 human Push-T episodes, and AGPD of the same student from the same episodes.
# usage: benchmarks/pusht/distil.sh cloning|agpd DATASET_ROOT OUTPUT_DIR [TEACHER] [more lerobot-train flags]
set -euo pipefail
export HF_HUB_OFFLINE=1 OMP_NUM_THREADS="${OMP_NUM_THREADS:-1}"
method=$1 root=$2 output=$3
shift 3
common=(--config_path="$(dirname "$0")/../../examples/presets/student_cpu.yaml"
    --dataset.repo_id=local/pusht20 --dataset.root="$root" --output_dir="$output"
    --steps=10000 --save_freq=2000 --log_freq=200 --seed=1000)
case $method in
cloning) exec lerobot-train "${common[@]}" --policy.collect.every=0 --policy.adversary.weight=0 "$@" ;;
agpd)
    teacher=$1
    shift
    exec lerobot-train "${common[@]}" --policy.teacher.path="$teacher" \
        --env.type=pusht --env.obs_type=environment_state_agent_pos --policy.collect.min_reward=0.9 \
        --policy.collect.warmup=1600 --policy.collect.every=650 --policy.collect.episodes=50 --policy.collect.n_envs=25 "$@"
    ;;
*) echo "unknown method '$method': cloning or agpd" >&2 && exit 2 ;;
esac
