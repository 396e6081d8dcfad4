#!/usr/bin/env bash
# The Push-T teacher: residual-MLP diffusion policy on all 206 human episodes (62 minutes on one core of a busy machine).
# usage: benchmarks/pusht_teacher/teacher.sh DATASET_ROOT OUTPUT_DIR [more lerobot-train flags]
set -euo pipefail
export HF_HUB_OFFLINE=1 OMP_NUM_THREADS="${OMP_NUM_THREADS:-1}"
root=$1 output=$2
shift 2
lerobot-train --policy.type=diffusion_transformer --policy.denoiser=mlp --policy.prediction_type=sample \
    --policy.noise_scheduler_type=DDIM --policy.num_inference_steps=16 \
    --policy.device=cpu --policy.use_amp=true --policy.push_to_hub=false \
    --dataset.repo_id=local/pusht_keypoints --dataset.root="$root" \
    --batch_size=64 --num_workers=0 --steps=26000 --save_freq=2000 --log_freq=500 \
    --env_eval_freq=0 --seed=1000 --output_dir="$output" "$@"
