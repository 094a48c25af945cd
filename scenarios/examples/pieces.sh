# Functions of the training scripts, which work in pieces of MINUTES; sourced, with `here` and `W` set.
# A step that was done is not done again. One that was stopped is continued by the next call.
# MARGIN_S: seconds between the end of a collection or training and that of its piece, for its last episodes, evaluation and
# files (90). On a fast host less is enough, and less of each piece is left unused.
END=$((SECONDS + ${MINUTES:-9} * 60))
MARGIN_S=${MARGIN_S:-90}
JOBS=${JOBS:-16} COSIM=${COSIM:-cosim} PYTHON=${PYTHON:-python3}
mkdir -p "$W"

step() { # name, words...: a command that can be interrupted and continued; done once
  local name=$1 left=$((END - SECONDS)); shift
  mkdir -p "$(dirname "$W/log/$name")"
  [ -e "$W/log/$name.done" ] && return 0
  [ $left -gt $((MARGIN_S + 15)) ] || { echo "time is up before $name: call again"; exit 1; }
  timeout -k 30 $left "$@" >> "$W/log/$name.txt" 2>&1 || { tail -n 3 "$W/log/$name.txt"; echo "stopped in $name: call again"; exit 1; }
  touch "$W/log/$name.done"; echo "$name: done"
}
learn() { # name, words...
  local name=$1; shift
  # Keep the memory of a step for the next one: freeing it and allocating it again took a third of the time.
  step "train-$name" env PYTHONPATH="$here" MALLOC_MMAP_THRESHOLD_=4000000000 MALLOC_TRIM_THRESHOLD_=8000000000 \
    "$PYTHON" -m cosim.learning "$@" -o "$W/nets/$name" \
    --minutes "$(awk "BEGIN { print ($END - $SECONDS - $MARGIN_S) / 60 }")" --resume
}
