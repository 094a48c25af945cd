#!/usr/bin/env bash
# From nothing to the table of a policy with a memory: demonstrations, rounds of DAgger, seeds, ablations, scores.
#
#   scenarios/examples/sidewalk_policy.sh WORK
#
# Works in pieces: stops after MINUTES (9 by default), and continues when called again, until it prints "all done".
# In round 0 the expert drives, disturbed; in later rounds the learner drives, and the expert's answers are stored. A round collects
# for about COLLECT minutes (8), with JOBS processes (16), in CITIES new cities (48). COSIM, PYTHON: see small_policy.sh.
# ROUNDS: number of rounds (3). STEPS: steps of each training (6000). BATCH: windows of 8 s in a step (48).
# SEEDS: trained on all rounds at the end ("0 1 2"). GPUS: trainings at once, one a GPU (1).
# ABLATIONS=1: trains seed 0 again with each single change. SPLIT: scored part of the suites (val).
# To continue from a bundle of another machine, without its data: FIRST=1 FROM=FOLDER, the first round and its learner.
# MOST: most episodes with an event of a round (100000).
# ROBOTS: which drive beside the courier ("scout dog"). WEATHERS: drawn for each episode.
set -uo pipefail
here=$(cd "$(dirname "$0")/../.." && pwd)
W=${1:?a folder to work in}
. "$here/scenarios/examples/pieces.sh"
ROUNDS=${ROUNDS:-3} COLLECT=${COLLECT:-8} CITIES=${CITIES:-48} STEPS=${STEPS:-6000} BATCH=${BATCH:-48}
SEEDS=${SEEDS-"0 1 2"} GPUS=${GPUS:-1} FIRST=${FIRST:-0} FROM=${FROM:-} SPLIT=${SPLIT:-val}
MOST=${MOST:-100000} ROBOTS=${ROBOTS-"scout dog"} WEATHERS=${WEATHERS:-clear,clear,clear,overcast,rain,heavy_rain,fog,low_sun,snow,night}
mkdir -p "$W/demos" "$W/nets" "$W/runs"

gather() { # name, share of COLLECT, most episodes, words...: as many episodes as fit in the time
  local name=$1 minutes most=$3; minutes=$(awk "BEGIN { print $2 * $COLLECT }"); shift 3
  step "collect-$name" bash -c '"$@" || [ $? = 1 ]' - $COSIM collect "$@" --minutes "$minutes" --episodes "$most" --fov 60 \
    --labels --format raw --weathers "$WEATHERS" --jobs "$JOBS" --out "$W/demos/$name" --resume
  step "pack-$name" $COSIM dataset pack "$W/demos/$name" -o "$W/packed/$name.npz" --jobs "$JOBS"
}
round() { # number, words of who drives...
  local k=$1; shift
  local new=(--cities $((900 + 100 * k)):$((900 + 100 * k + CITIES)) --city-size 1000 --seed "$k" --astray 0.3 --unsolved)
  mkdir -p "$W/packed"
  gather "$k-reactive" 0.55 "$MOST" reactive --decoys "${new[@]}" "$@"
  gather "$k-unit" 0.1 $((60 * JOBS)) unit "${new[@]}" "$@"
  gather "$k-long" 0.2 $((12 * JOBS)) long-horizon "${new[@]}" "$@"
  for robot in $ROBOTS; do
    gather "$k-$robot" 0.075 $((30 * JOBS)) reactive --decoys --robot "$robot" "${new[@]}" "$@"
  done
}
parts() { # last round: the packed files up to it
  for k in $(seq "$FIRST" "$1"); do ls "$W"/packed/"$k"-*.npz; done
}
sidewalk() { # name, last round, words...
  local name=$1 last=$2; shift 2
  learn "$name" $(parts "$last") --network sidewalk --batch "$BATCH" --steps "$STEPS" --rate 5e-4 "$@"
}
together() { # what, names...: trainings beside each other, one a GPU
  local what=$1 number=0 name; shift
  for name in "$@"; do
    CUDA_VISIBLE_DEVICES=$((number % GPUS)) "$what" "$name" &
    number=$((number + 1)); [ $((number % GPUS)) = 0 ] && wait
  done
  wait
  for name in "$@"; do [ -e "$W/log/train-$name.done" ] || exit 1; done
}
seed() { sidewalk "$1" $((FIRST + ROUNDS - 1)) --seed "${1##*-}" ${FROM:+--from "$FROM"}; }
ablation() {
  local words=(); case $1 in share-*) words=(--share "${1#share-}") ;; no-*) words=("--$1") ;; esac
  sidewalk "$1" $((FIRST + ROUNDS - 1)) --seed 0 "${words[@]}"
}
score() { # name, suite, words...
  local name=$1 suite=$2 more=(); shift 2
  [ -e "$W/runs/$suite-$name/run.json" ] && more=(--resume)
  step "run-$suite-$name" $COSIM run "$suite" --split "$SPLIT" --seed 1 --jobs "$JOBS" --policy "onnx:$W/nets/$name" \
    --out "$W/runs/$suite-$name" "$@" "${more[@]}"
}

learner=$FROM
for k in $(seq "$FIRST" $((FIRST + ROUNDS - 1))); do
  if [ -z "$learner" ]; then
    round "$k" --noise 0.3
  else
    round "$k" --noise 0.7 --learner "onnx:$learner"
  fi
  if [ "$k" -lt $((FIRST + ROUNDS - 1)) ]; then
    sidewalk "round$k" "$k" --seed 0 ${learner:+--from "$learner"}
    learner=$W/nets/round$k
  fi
done
names=(); for s in $SEEDS; do names+=("sidewalk-$s"); done
together seed "${names[@]}"
if [ "${ABLATIONS:-0}" = 1 ]; then
  changes=(share-0.01 share-0.1 whole no-memory no-auxiliary no-decoys no-weather)
  together ablation "${changes[@]}"
  names+=("${changes[@]}")
fi
for suite in unit reactive long-horizon; do
  for name in "${names[@]}"; do score "$name" "$suite"; done
done
echo "all done"
