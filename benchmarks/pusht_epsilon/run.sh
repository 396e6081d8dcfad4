#!/usr/bin/env bash
# A Push-T teacher that predicts noise (epsilon), or the same network predicting the clean chunk (sample): train, evaluate 100
# episodes, measure the spread of its samples. Started again, it goes on from the last checkpoint.
# usage: benchmarks/pusht_epsilon/run.sh epsilon|sample DATASET_ROOT OUTPUT_DIR      (about 40 minutes on one idle core)
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
export HF_HUB_OFFLINE=1 OMP_NUM_THREADS="${OMP_NUM_THREADS:-1}" MUJOCO_GL="${MUJOCO_GL:-egl}"
prediction=$1 root=$2 output=$3
last="$output/checkpoints/last/pretrained_model"
if [ -e "$output/checkpoints/last" ]; then
    lerobot-train --config_path="$last/train_config.json" --resume=true
else
    "$here/../pusht_teacher/teacher.sh" "$root" "$output" --policy.prediction_type="$prediction" \
        --policy.use_amp=false --steps=16000
fi
lerobot-agpd-report --env.type=pusht --env.obs_type=environment_state_agent_pos \
    --policies="{teacher: $last}" --episodes=100 --batch_size=20 --output="$output/report"
python "$here/../adroit/spread.py" "$last" "$root" "$output/spread.json"
python "$here/../adroit/collect.py" "$here/teachers.json" "$prediction" "$output"
