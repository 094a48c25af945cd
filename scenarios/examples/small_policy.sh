#!/usr/bin/env bash
# From nothing to the table of a small policy: demonstrations, training, fine-tuning with three seeds, scores, comparison.
# Each event is collected three times: driven by the expert, and twice by what was learned so far (`collect --learner`).
#
#   scenarios/examples/small_policy.sh WORK
#
# Works in pieces: stops after MINUTES (9 by default), and continues when called again, until it prints "all done".
# JOBS: number of environment processes (16). COSIM: the command (cosim).
# PYTHON: a Python from 3.11 on with PyTorch, onnx and numpy (python3); it needs only the folder of this project.
# For 16 cores and a GPU. On two cores set OMP_NUM_THREADS=2 and BATCH=64 (256).
# Fewer demonstrations: UNIT (1500), EACH (500 of each event), AGAIN (200 of each event in a round).
# Fewer steps: STEPS (16000), MORE (8000, of the fine-tuning). EVENTS: kinds that are learned (all eight).
set -uo pipefail
here=$(cd "$(dirname "$0")/../.." && pwd)
W=${1:?a folder to work in}
. "$here/scenarios/examples/pieces.sh"
EVENTS=${EVENTS:-"obstructing conversing queueing frontal lateral overtaking ped_crossing gesturing"}
mkdir -p "$W/demos/events" "$W/nets" "$W/runs"

collect() { # name, words...
  local name=$1; shift
  step "collect-$name" $COSIM collect "$@" --fov 60 --jobs "$JOBS" --out "$W/demos/$name" --resume
}
collect_again() { # round, learner, cities: what the expert would have done where the learner drives
  for event in $EVENTS; do
    collect "$1/$event" reactive --event "$event" --episodes "${AGAIN:-200}" --cities "$3" --noise 0.7 --learner "$2" --unsolved
  done
  step "pack-$1" $COSIM dataset pack "$W/demos/$1"/* -o "$W/$1.npz"
}
finetune() { # folder, what it is called, seed, data...
  local folder=$1 called=$2 seed=$3; shift 3
  learn "$folder" "$@" "$W/unit.npz" --batch "${BATCH:-256}" --from "$W/nets/small" --seed "$seed" --steps "${MORE:-8000}" --rate 3e-4 --name "$called"
}
score() { # name, policy, suite
  local more=(); [ -e "$W/runs/$3-$1/run.json" ] && more=(--resume)
  step "run-$3-$1" $COSIM run "$3" --split test --seed 1 --jobs "$JOBS" --policy "$2" --out "$W/runs/$3-$1" "${more[@]}"
}

drawn=(--cities 900:940 --noise 0.2)
collect unit unit --episodes "${UNIT:-1500}" "${drawn[@]}"
for event in $EVENTS; do
  collect "events/$event" reactive --event "$event" --episodes "${EACH:-500}" "${drawn[@]}"
done
step pack-unit $COSIM dataset pack "$W/demos/unit" -o "$W/unit.npz"
step pack-events $COSIM dataset pack "$W"/demos/events/* -o "$W/events.npz"
learn small "$W/unit.npz" --batch "${BATCH:-256}" --steps "${STEPS:-16000}"
collect_again round1 "onnx:$W/nets/small" 940:980
finetune halfway small-halfway 0 "$W/events.npz" "$W/round1.npz"
collect_again round2 "onnx:$W/nets/halfway" 980:1020
for seed in 0 1 2; do
  finetune small-reactive-$seed small-reactive $seed "$W/events.npz" "$W/round1.npz" "$W/round2.npz"
done
for suite in unit reactive long-horizon; do
  for net in small small-reactive-0 small-reactive-1 small-reactive-2; do score $net "onnx:$W/nets/$net" $suite; done
done
step compare $COSIM compare "$W"/runs/reactive-small{,-reactive-0,-reactive-1,-reactive-2} -o "$W/finetuning.md"
cat "$W/finetuning.md"
echo "all done"
