# What the examples share: record demonstrations, train a teacher, distill it, evaluate. Source it; every step that is
# finished is skipped when the script runs again, an interrupted training goes on from its last checkpoint.
set -euo pipefail
presets=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)/presets
export HF_HUB_OFFLINE=${HF_HUB_OFFLINE:-1} OMP_NUM_THREADS=${OMP_NUM_THREADS:-1}

# Sizes, each of which the caller's environment can change (FEW=5 TEACHER_STEPS=100 ... for a quick look).
FEW=${FEW:-20}                             # demonstrations of the student
MANY=${MANY:-200}                          # demonstrations of the teacher
SKILL=${SKILL:-1}                          # operators of the student's demonstrations; "[1,0.75,0.5,0.25]" is a mixture
TEACHER_STEPS=${TEACHER_STEPS:-6000}       # gradient steps of the teacher
STUDENT_STEPS=${STUDENT_STEPS:-4000}       # gradient steps of the students
ROUND_EPISODES=${ROUND_EPISODES:-50}       # episodes of each of five collection rounds
EVALUATION_EPISODES=${EVALUATION_EPISODES:-200}

# settings OUTPUT: refuse a folder that was made with other sizes, whose finished steps would be taken for these
settings() {
    local now="FEW=$FEW MANY=$MANY SKILL=$SKILL TEACHER_STEPS=$TEACHER_STEPS STUDENT_STEPS=$STUDENT_STEPS ROUND_EPISODES=$ROUND_EPISODES"
    mkdir -p "$1"
    if [ -e "$1/settings" ] && [ "$(cat "$1/settings")" != "$now" ]; then
        echo "$1 was made with $(cat "$1/settings"), not with $now; name another output folder" >&2
        exit 1
    fi
    echo "$now" > "$1/settings"
}

# record FOLDER EPISODES SEED FLAGS...
record() {
    [ -d "$1" ] && return
    lerobot-agpd-demos --root="$1" --episodes="$2" --seed="$3" "${@:4}"
}

# train FOLDER FLAGS...
train() {
    local last=$1/checkpoints/last/pretrained_model/train_config.json
    if [ -e "$1/finished" ]; then
        return
    elif [ -e "$last" ]; then
        lerobot-train --config_path="$last" --resume=true
    else
        rm -rf "$1"
        lerobot-train --output_dir="$1" --save_freq=1000 --log_freq=200 "${@:2}"
    fi
    touch "$1/finished"
}

# teacher FOLDER DATASET FLAGS...
teacher() {
    train "$1" --config_path="$presets/teacher_cpu.yaml" --dataset.repo_id=local/teacher --dataset.root="$2" \
        --steps="$TEACHER_STEPS" "${@:3}"
}

# cloning FOLDER DATASET FLAGS...: the student from its demonstrations alone
cloning() {
    train "$1" --config_path="$presets/student_cpu.yaml" --dataset.repo_id=local/student --dataset.root="$2" \
        --steps="$STUDENT_STEPS" --policy.collect.every=0 --policy.adversary.weight=0 "${@:3}"
}

# distill FOLDER DATASET TEACHER FLAGS...: the same student with five guided rounds and the adversary
distill() {
    local every=$((STUDENT_STEPS * 3 / 20)) warmup=$((STUDENT_STEPS / 8))
    train "$1" --config_path="$presets/student_cpu.yaml" --dataset.repo_id=local/student --dataset.root="$2" \
        --steps="$STUDENT_STEPS" --policy.teacher.path="$3/checkpoints/last/pretrained_model" \
        --policy.collect.warmup="$warmup" --policy.collect.every="$every" --policy.collect.rounds=5 \
        --policy.collect.episodes="$ROUND_EPISODES" "${@:4}"
}

# report OUTPUT FLAGS...: teacher, cloning and AGPD student on seeds that nothing used
report() {
    lerobot-agpd-report --output="$1/report" --episodes="$EVALUATION_EPISODES" \
        --policies="{teacher: $1/teacher/checkpoints/last/pretrained_model}" \
        --runs="{cloning: $1/cloning, AGPD student: $1/agpd}" "${@:2}"
    cat "$1/report/report.md"
}
