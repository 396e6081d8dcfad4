#!/usr/bin/env bash
# Three cubes, any of which may be lifted. A diffusion teacher knows all three ways; a small ACT student learns from 20
# demonstrations, once by cloning them and once by AGPD. Offline, on a CPU. How teacher and demonstrations were made is
# at the end.
# usage: examples/quickstart.sh [output folder, default outputs/quickstart]
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
output=${1:-outputs/quickstart}
export HF_HUB_OFFLINE=1 OMP_NUM_THREADS=${OMP_NUM_THREADS:-1} MUJOCO_GL=${MUJOCO_GL:-egl}
# Sizes, each of which the caller's environment can change (STEPS=60 EPISODES=4 ... for a quick look).
STEPS=${STEPS:-1800}                            # gradient steps of both students
ROUND_EPISODES=${ROUND_EPISODES:-50}            # episodes of each of five collection rounds
EVALUATION_EPISODES=${EVALUATION_EPISODES:-100} # episodes that every policy is evaluated on
FILM_EPISODES=${FILM_EPISODES:-2}               # episodes of the animation
if [ -e "$output" ]; then
    echo "$output already exists; remove it or name another folder" >&2
    exit 1
fi
mkdir -p "$output/log"
# Ctrl-C and failures end what runs in the background, too: each job is a process group of its own.
set -m
trap 'for job in $(jobs -p); do kill -- "-$job" 2>/dev/null || true; done' EXIT

teacher=$here/lift_any/teacher
last=checkpoints/last/pretrained_model
env=(--env.type=robosuite_ways --env.task=LiftAny-v0)
# A student of a quarter of the preset's size: enough for 18 numbers.
student=(--config_path="$here/presets/student_cpu.yaml" --policy.dim_model=64 --policy.dim_feedforward=256
    --dataset.repo_id=local/lift_any --dataset.root="$here/lift_any/demonstrations"
    --steps="$STEPS" --save_freq=$((STEPS / 3)) --log_freq=$((STEPS / 12)))
report=(lerobot-agpd-report "${env[@]}" --output="$output" --episodes="$EVALUATION_EPISODES" --batch_size=10)

# phase NAME LOG COMMAND...: run a command with all that it prints in a log, and its progress on one line. (Without FFmpeg's
# libraries the logs begin with tracebacks of LeRobot; data without videos needs none.)
phase() {
    local name=$1 log=$output/log/$2.log start=$SECONDS job now
    shift 2
    "$@" >"$log" 2>&1 &
    job=$!
    while kill -0 $job 2>/dev/null; do
        if [ -t 1 ]; then
            now=$(tail -c 3000 "$log" | tr '\r' '\n' | grep -oE '\| [0-9]+/[0-9]+' | tail -n 1 || true)
            printf '\r%-52s %-14s %s ' "$name" "${now#| }" "$(clock $((SECONDS - start)))"
        fi
        sleep 1
    done
    wait $job || { printf '\n%s\n' "failed: $name; the end of $log:" >&2 && tail -n 30 "$log" >&2 && exit 1; }
    [ -t 1 ] && printf '\r'
    printf '%-52s %-14s %s\n' "$name" done "$(clock $((SECONDS - start)))"
}
wait_for() { while kill -0 "$1" 2>/dev/null; do sleep 1; done; }
clock() { printf '%d:%02d' $(($1 / 60)) $(($1 % 60)); }

# The second core clones the demonstrations, then evaluates that student and the teacher.
{
    lerobot-train "${student[@]}" --output_dir="$output/cloned" --policy.collect.every=0 --policy.adversary.weight=0 \
        >"$output/log/cloned.log" 2>&1 &&
        "${report[@]}" --policies="{teacher: $teacher}" --runs="{cloned: $output/cloned}" >"$output/log/first_report.log" 2>&1
} &
cloning=$!

phase "1/4 AGPD: five rounds of $ROUND_EPISODES episodes" agpd lerobot-train "${student[@]}" "${env[@]}" \
    --output_dir="$output/agpd" --policy.teacher.path="$teacher" --policy.collect.n_envs=10 --policy.collect.rounds=5 \
    --policy.collect.warmup=$((STEPS / 6)) --policy.collect.every=$((STEPS / 6)) --policy.collect.episodes="$ROUND_EPISODES"
phase "2/4 cloning the demonstrations, on the second core" wait_for_cloning wait_for $cloning
wait $cloning || { tail -n 30 "$output"/log/{cloned,first_report}.log >&2 && exit 1; }
phase "3/4 animation and recording" viz lerobot-agpd-viz "${env[@]}" --env.visualization_width=320 \
    --env.visualization_height=320 --policy.path="$output/agpd/$last" --output="$output/guided.rrd" --png="$output/guided.png" \
    --policies="{teacher: $teacher, cloned: $output/cloned/$last, distilled: $output/agpd/$last}" \
    --episodes="$FILM_EPISODES" --speed=0.5 --animation="$output/side_by_side.gif"
phase "4/4 evaluation on seeds that nothing else used" report "${report[@]}" --title="Lift any of three cubes" \
    --policies="{teacher: $teacher}" --runs="{cloned: $output/cloned, distilled: $output/agpd}" \
    --pictures="[$output/side_by_side.gif, $output/guided.png]" --sheet_episodes=16

cat <<END

$(cat "$output/report.md")

look    $output/report.html (curves, rounds, ways, pictures), $output/side_by_side.gif
        rerun $output/guided.rrd (the teacher being guided, with its chunks)
next    lerobot-agpd-export --checkpoint=$output/agpd/$last --output=$output/plain
        examples/fetch.sh, or your own task: docs/tutorial.md
END

# Teacher and demonstrations come from the project's own commands:
#   lerobot-agpd-demos --env.type=robosuite_ways --env.task=LiftAny-v0 --episodes=20 --seed=5000 --root=...
#   lerobot-agpd-demos --env.type=robosuite_ways --env.task=LiftAny-v0 --episodes=300 --seed=10000 --root=...
#   lerobot-train --config_path=examples/presets/teacher_cpu.yaml --steps=4000 --dataset.repo_id=... --dataset.root=...
