#!/usr/bin/env bash
# One door teacher from DAPG's human demonstrations: train, evaluate 50 episodes, measure the spread of its samples.
# Started again, it goes on from the last checkpoint.
# usage: benchmarks/adroit/teacher.sh DATASET_ROOT OUTPUT_DIR [more lerobot-train flags]
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
export HF_HUB_OFFLINE=1 OMP_NUM_THREADS=${OMP_NUM_THREADS:-1} MUJOCO_GL=${MUJOCO_GL:-egl}
root=$1 output=$2
shift 2
last="$output/checkpoints/last/pretrained_model"
if [ -e "$output/checkpoints/last" ]; then
    lerobot-train --config_path="$last/train_config.json" --resume=true
else
    lerobot-train --config_path="$here/../../examples/presets/teacher_cpu.yaml" \
        --dataset.repo_id=local/adroit --dataset.root="$root" \
        --seed=1000 --log_freq=500 --save_freq=1000 --output_dir="$output" "$@"
fi
lerobot-agpd-report --env.type=gymnasium_robotics --env.task=AdroitHandDoor-v1 --env.episode_length=300 \
    --policies="{teacher: $last}" --episodes=50 --batch_size=10 --output="$output/report"
python "$here/spread.py" "$last" "$root" "$output/spread.json"
python "$here/collect.py" "$here/teachers.json" "$(basename "$output")" "$output"
