#!/usr/bin/env bash
# From nothing to the table of a policy with a memory: demonstrations, rounds of DAgger, seeds, rewards, ablations, scores.
#
#   scenarios/examples/sidewalk_policy.sh WORK
#
# Works in pieces: stops after MINUTES (9 by default), and continues when called again, until it prints "all done".
# In round 0 the expert drives, disturbed; in later rounds the learner drives, and the expert's answers are stored. A round collects
# for COLLECT minutes (7, less than MINUTES) in all, with JOBS processes (16), in CITIES new cities (48; at most 50), a multiple of GPUS, and gestures in as many others.
# Shares of JOBS: reactive 0.42, gesturing alone 0.17, long routes 0.14, short ways over crossings with signals 0.08, unit 0.05, and 0.07 for each of ROBOTS.
# COSIM, PYTHON: see small_policy.sh.
# ROUNDS: number of rounds (3). STEPS: steps of each training (6000). BATCH: windows of 8 s in a step (48).
# SEEDS: trained on all rounds at the end ("0 1 2"; "" for none). GPUS: number of GPUs (1); each trains PER_GPU networks at a time (1).
# VALUES: temperature of the fine-tuning on rewards (1; "" for none). The first seed's policy explores, and is trained on what it drove,
# weighted by values, for MORE steps (2000). WORK/kept.txt has the better one of both on val.
# ABLATIONS=1: trains seed 0 again with each change of docs/learning.md. QUESTIONS=1: fine-tunes on one EVENT (gesturing) alone, and
# scores the first seed's policy with random goals in place of route goals. SPLIT, SUITES: what is scored (val; all three). RUN: more words for cosim run.
# AT_ONCE: networks that are scored at a time (1), each with its share of JOBS.
# Tables are WORK/NAME.md, their pictures WORK/NAME.png; each compares with its first row. SUITE has all policies, SUITE-ablations the changes
# against seed 0 from new parameters, reactive-black the policy that is kept with and without pictures.
# To continue from a bundle of another machine, without its data: FIRST=1 FROM=FOLDER, the first round and its learner, with pictures of 320 x 180.
# MOST: most episodes of a collection (100000); small ones are drawn faster, which matters on few cores.
# EXPERT: whose commands are stored (orca-hasty, which at rest does not wait out of caution).
# FOV: degrees of the camera from its lower to its upper edge (75). A learner sees the same camera.
# ROBOTS: further robots that collect, besides the courier ("scout dog"). WEATHERS: names from which each episode's is drawn.
set -uo pipefail
here=$(cd "$(dirname "$0")/../.." && pwd)
W=${1:?a folder to work in}
. "$here/scenarios/examples/pieces.sh"
VALUES=${VALUES-1} MORE=${MORE:-2000} EVENT=${EVENT:-gesturing} RUN=${RUN:-}
ROUNDS=${ROUNDS:-3} COLLECT=${COLLECT:-7} CITIES=${CITIES:-48} STEPS=${STEPS:-6000} BATCH=${BATCH:-48}
SEEDS=${SEEDS-"0 1 2"} GPUS=${GPUS:-1} PER_GPU=${PER_GPU:-1} FIRST=${FIRST:-0} FROM=${FROM:-} AT_ONCE=${AT_ONCE:-1} SPLIT=${SPLIT:-val} SUITES=${SUITES-"unit reactive long-horizon"}
MOST=${MOST:-100000} EXPERT=${EXPERT:-orca-hasty} ROBOTS=${ROBOTS-"scout dog"} FOV=${FOV:-75} WEATHERS=${WEATHERS:-clear,clear,clear,overcast,rain,heavy_rain,fog,low_sun,snow,night}
mkdir -p "$W/demos" "$W/nets" "$W/runs"

awk "BEGIN { exit !($COLLECT < ${MINUTES:-9}) }" || { echo "COLLECT=$COLLECT must be less than MINUTES=${MINUTES:-9}"; exit 2; }

gather() ( # name, share of JOBS, GPU, most episodes, words...: as many episodes as fit in COLLECT minutes, over all calls
  name=$1 gpu=$3 most=$4 jobs=$(awk "BEGIN { n = int($2 * $JOBS + 0.5); print n < 1 ? 1 : n }"); shift 4
  export USED=$W/log/collect-$name.seconds DEMO=$W/demos/$name LAST
  [ -e "$W/log/collect-$name.done" ] && return 0
  rest=$(awk "BEGIN { n = int(60 * $COLLECT) - $(cat "$USED" 2> /dev/null || echo 0); print n < 1 ? 1 : n }")
  now=$((END - SECONDS - MARGIN_S)); [ "$now" -lt "$rest" ] || now=$rest
  LAST=$((now == rest))
  [ "$most" -lt "$MOST" ] || most=$MOST
  # Exit code 4: the time is up. The collection is done if this was the rest of its time, and an episode is finished.
  GLCONTEXT_DEVICE_INDEX=$gpu step "collect-$name" bash -c '"$@"; code=$?; [ $code = 4 ] || exit $code
    if [ $LAST = 1 ] && ! compgen -G "$DEMO/runs/*/episodes/*/demonstration.npz" > /dev/null; then
      rm -f "$USED"; echo "no episode in COLLECT minutes: continuing"; exit 1
    fi
    echo $(($(cat "$USED" 2> /dev/null || echo 0) + SECONDS)) > "$USED"; [ $LAST = 1 ]' - \
    $COSIM collect "$@" --policy "$EXPERT" --minutes "$(awk "BEGIN { print $now / 60 }")" --episodes "$most" --camera 320x180 --fov "$FOV" --labels --format raw \
    --weathers "$WEATHERS" --jobs "$jobs" --out "$W/demos/$name" --resume
)
finished() { # step, names...: ends the script unless this step is done for all of them
  local step=$1 name; shift
  for name in "$@"; do [ -e "$W/log/$step-$name.done" ] || exit 1; done
}
together() { # how many, step, what, names...: calls `what NAME` for each name, so many at a time, spread over the GPUs, with `share` of JOBS each
  local most=$1 step=$2 what=$3 number=0 name share=$((JOBS > $1 ? JOBS / $1 : 1)); shift 3
  for name in "$@"; do
    CUDA_VISIBLE_DEVICES=$((number % GPUS)) GLCONTEXT_DEVICE_INDEX=$((number % GPUS)) "$what" "$name" &
    number=$((number + 1)); [ $((number % most)) = 0 ] && wait
  done
  wait
  finished "$step" "$@"
}
pack() { step "pack-$1" $COSIM dataset pack "$W/demos/$1" -o "$W/packed/$1.npz" --part 16 --jobs "$share"; }
packed() { # names...: packs their collections at the same time, when all are done
  mkdir -p "$W/packed"
  finished collect "$@"
  together $# pack pack "$@"
}
signals() { # first city, number: prints a scenario file: so many short ways over crossings with signals, drawn in each city
  printf 'name = "signals"\nseeds = %s\n[place]\ncity = [%s]\nsize_m = 1000\n[way]\nkind = "crosswalk"\nsignals = "with"\n' \
    "$2" "$(seq -s ', ' "$1" $(($1 + CITIES - 1)))"
  printf '[crowd]\npersons = 15\nvehicles = 10\n[limits]\ntime_s = 180\n'
}
round() { # name, number, words of the driver...: collects in parallel, then packs
  local k=$1 number=$2 first=$((900 + 100 * $2)) each=$((CITIES / GPUS)) names=("$1-unit" "$1-long" "$1-signals" "$1-gesturing") gpu=0 limit; shift 2
  limit=$(awk "BEGIN { print int(3 * $JOBS * $COLLECT) + 3 }")  # an upper limit: drawing more would take long
  local common=(--seed "$number" --astray 0.3 --unsolved "$@")
  local all=(--cities $first:$((first + CITIES)) --city-size 1000 "${common[@]}")
  gather "$k-unit" 0.05 0 "$limit" unit "${all[@]}" &
  gather "$k-long" 0.14 $((GPUS - 1)) "$((limit / 3))" long-horizon "${all[@]}" &
  signals "$first" $((limit / CITIES / 10 + 1)) > "$W/signals-$k.toml"
  gather "$k-signals" 0.08 $((GPUS / 2)) "$MOST" "$W/signals-$k.toml" "${common[@]}" &
  gather "$k-gesturing" 0.17 $((GPUS / 2)) "$limit" reactive --decoys --event gesturing \
    --cities $((first + CITIES)):$((first + 2 * CITIES)) --city-size 1000 "${common[@]}" &
  while [ $gpu -lt "$GPUS" ]; do
    names+=("$k-reactive-$gpu")
    gather "$k-reactive-$gpu" "0.42 / $GPUS" $gpu "$MOST" reactive --decoys \
      --cities $((first + gpu * each)):$((first + (gpu + 1) * each)) --city-size 1000 "${common[@]}" &
    gpu=$((gpu + 1))
  done
  for robot in $ROBOTS; do
    names+=("$k-$robot")
    gather "$k-$robot" 0.07 $((${#names[@]} % GPUS)) "$limit" reactive --decoys --robot "$robot" "${all[@]}" &
  done
  wait
  packed "${names[@]}"
}
parts() { # last round: the packed files up to it
  for k in $(seq "$FIRST" "$1"); do ls "$W"/packed/"$k"-*.npz; done
}
network() { # name, words...
  local name=$1; shift
  learn "$name" --network sidewalk --batch "$BATCH" --name "sidewalk-${name#sidewalk-}" "$@"
}
sidewalk() { # name, last round, words...
  local name=$1 last=$2; shift 2
  network "$name" $(parts "$last") --steps "$STEPS" --rate 5e-4 "$@"
}
trained() { # what, names...: trains in parallel, PER_GPU networks on each GPU
  local what=$1; shift
  together $((GPUS * PER_GPU)) train "$what" "$@"
}
seed() { sidewalk "$1" $((FIRST + ROUNDS - 1)) --seed "${1##*-}" ${FROM:+--from "$FROM"}; }
ablation() {
  local words=(); case $1 in share-*) words=(--share "${1#share-}") ;; no-*) words=("--$1") ;; esac
  sidewalk "$1" $((FIRST + ROUNDS - 1)) --seed 0 "${words[@]}"
}
score() { # name, suite, policy, split, words...
  local name=$1 suite=$2 policy=$3 split=${4:-$SPLIT}; shift "$(($# < 4 ? $# : 4))"
  local more=(); [ -e "$W/runs/$name/run.json" ] && more=(--resume)
  step "run-$name" $COSIM run "$suite" --split "$split" --seed 1 --jobs "${share:-$JOBS}" --policy "$policy" --out "$W/runs/$name" $RUN "$@" "${more[@]}"
}
driven() { # name: drives `suite` with a network
  score "$suite-$1" "$suite" "onnx:$W/nets/$1"
}
compared() { # name, words...: compares runs, and shows the end of the output if that fails
  local name=$1; shift
  $COSIM compare "$@" > "$W/log/compare-$name.txt" 2>&1 || { tail -n 3 "$W/log/compare-$name.txt"; exit 1; }
}
table() { # name, runs...: compares the others with the first one; without a picture if that fails, as it does without matplotlib
  local name=$1; shift
  (compared "$name" "$@" -o "$W/$name.md" -o "$W/$name.png" --by policy) || {
    echo "no picture $W/$name.png"; compared "$name" "$@" -o "$W/$name.md" --by policy
  }
  echo "$name:"; cat "$W/$name.md"
}
values() { # learner: fine-tunes it on rewards; writes the better one of both on val to WORK/kept.txt
  local where=val-reactive name; [ "$SPLIT" = val ] && where=reactive
  round values $((FIRST + ROUNDS)) --learner "onnx:$W/nets/$1" --explore 0.3
  network values $(parts $((FIRST + ROUNDS - 1))) "$W"/packed/values-*.npz --from "$W/nets/$1" --values "$VALUES" \
    --steps "$MORE" --rate 1e-4 --seed 0
  for name in "$1" values; do score "$where-$name" reactive "onnx:$W/nets/$name" val; done
  compared values "$W/runs/$where-$1" "$W/runs/$where-values" -o "$W/values.csv"
  # Kept if of SR and D on val one rises, and none falls.
  awk -F, -v was="$1" 'NR == 1 { for (i = 1; i <= NF; i++) at[$i] = i; next }
    $at["by"] == "suite" && ($at["metric"] == "success" || $at["metric"] == "discerned") {
      change = $at["value_after"] - $at["value_before"]; rises += change > 0; falls += change < 0
      print "fine-tuning on rewards:", $at["metric"], $at["value_before"], "to", $at["value_after"], $at["verdict"] > "/dev/stderr" }
    END { print (rises && !falls) ? "values" : was }' "$W/values.csv" > "$W/kept.txt.part" || exit 1
  mv "$W/kept.txt.part" "$W/kept.txt"
  echo "kept: $(cat "$W/kept.txt")"
}
questions() { # learner: does fine-tuning on one event cost others?
  local number=$((FIRST + ROUNDS + 1))
  gather event 1 0 "$MOST" reactive --event "$EVENT" --decoys --cities $((900 + 100 * number)):$((900 + 100 * number + CITIES)) \
    --city-size 1000 --seed "$number" --astray 0.3 --unsolved --learner "onnx:$W/nets/$1" --noise 0.7
  packed event
  network event "$W"/packed/event-*.npz --from "$W/nets/$1" --steps "$MORE" --rate 1e-4 --seed 0
}

learner=$FROM
for k in $(seq "$FIRST" $((FIRST + ROUNDS - 1))); do
  if [ -z "$learner" ]; then
    round "$k" "$k" --noise 0.3
  else
    round "$k" "$k" --noise 0.7 --learner "onnx:$learner"
  fi
  if [ "$k" -lt $((FIRST + ROUNDS - 1)) ]; then
    sidewalk "round$k" "$k" --seed 0 ${learner:+--from "$learner"}
    learner=$W/nets/round$k
  fi
done
names=() changes=() control=
for number in $SEEDS; do names+=("sidewalk-$number"); done
trained seed "${names[@]}"
first=${names[0]:-} kept=${names[0]:-}
if [ -n "$first" ] && [ -n "$VALUES" ]; then
  values "$first"
  kept=$(cat "$W/kept.txt")
  names+=(values)
fi
if [ -n "$first" ] && [ "${QUESTIONS:-0}" = 1 ]; then
  questions "$first"
  names+=(event)
fi
if [ "${ABLATIONS:-0}" = 1 ]; then
  changes=(share-0.01 share-0.1 share-0.3 share-0.5 no-memory no-auxiliary no-decoys no-weather)
  control=sidewalk-0  # seed 0, trained from new parameters on everything
  if [ -n "$FROM" ] || [[ " $SEEDS " != *" 0 "* ]]; then changes+=(whole) control=whole; fi
  trained ablation "${changes[@]}"
  names+=("${changes[@]}")
fi
for suite in $SUITES; do
  together "$AT_ONCE" "run-$suite" driven "${names[@]}"
  if [ -n "$first" ] && [ "${QUESTIONS:-0}" = 1 ]; then
    score "$suite-random-goals" "$suite" "onnx:$W/nets/$first" "$SPLIT" --goal random_point
  fi
done
if [ -n "$first" ] && [[ " $SUITES " = *" reactive "* ]]; then
  export POLICY=onnx:$W/nets/$kept
  score reactive-black reactive "$here/scenarios/examples/black_pictures.py:Blinded"
fi
for suite in $SUITES; do
  runs=()
  for name in "${names[@]}" random-goals; do [ -e "$W/runs/$suite-$name/run.json" ] && runs+=("$W/runs/$suite-$name"); done
  [ ${#runs[@]} -gt 1 ] && table "$suite" "${runs[@]}"
  if [ -n "$control" ]; then
    runs=("$W/runs/$suite-$control")
    for name in "${changes[@]}"; do [ "$name" = "$control" ] || runs+=("$W/runs/$suite-$name"); done
    table "$suite-ablations" "${runs[@]}"
  fi
done
[ -e "$W/runs/reactive-black/run.json" ] && table reactive-black "$W/runs/reactive-$kept" "$W/runs/reactive-black"
echo "all done"
