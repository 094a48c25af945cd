# Functions of the training scripts, which work in pieces of MINUTES; sourced, with `here` and `W` set.
# A step that was done is not done again. One that was stopped is continued by the next call.
# MARGIN_S: seconds between the end of a collection or training and that of its piece, for its last episodes, evaluation and
# files (90). On a fast host less is enough, and less of each piece is left unused.
END=$((SECONDS + ${MINUTES:-9} * 60))
MARGIN_S=${MARGIN_S:-90}
JOBS=${JOBS:-16} COSIM=${COSIM:-cosim} PYTHON=${PYTHON:-python3}
mkdir -p "$W"

# Steps inherit the lock: one that outlives a killed script holds it, too.
exec 9> "$W/lock"
flock -n 9 || { echo "$W is in use: another call works there, or a step of a killed one. Try again when it has ended, after ${MINUTES:-9} minutes at most"; exit 1; }
trap 'end_steps; exit 129' HUP
trap 'end_steps; exit 130' INT
trap 'end_steps; exit 143' TERM

end_steps() { # ends all processes that this one started, and theirs; all at once, so that none goes on with what follows
  kill -TERM $(cat /proc/[0-9]*/stat 2> /dev/null | awk -v root=$$ '{ pid = $1; sub(/^.*\) /, ""); parent[pid] = $2 }
    END { for (pid in parent) { for (one = pid; one in parent && one != root;) one = parent[one]; if (one == root && pid != root) print pid } }') 2> /dev/null
}
step() { # name, words...: a command that can be interrupted and continued; done once
  local name=$1 left=$((END - SECONDS)); shift
  mkdir -p "$(dirname "$W/log/$name")"
  [ -e "$W/log/$name.done" ] && return 0
  [ $left -gt $((MARGIN_S + 15)) ] || { echo "time is up before $name: call again"; exit 1; }
  # In the background, so that a signal is handled at once.
  timeout -k 30 $left "$@" >> "$W/log/$name.txt" 2>&1 &
  wait $! || { tail -n 3 "$W/log/$name.txt"; echo "stopped in $name: call again"; exit 1; }
  touch "$W/log/$name.done"; echo "$name: done"
}
learn() { # name, words...
  local name=$1; shift
  # Keep the memory of a step for the next one: freeing it and allocating it again took a third of the time.
  step "train-$name" env PYTHONPATH="$here" MALLOC_MMAP_THRESHOLD_=4000000000 MALLOC_TRIM_THRESHOLD_=8000000000 \
    "$PYTHON" -m cosim.learning "$@" -o "$W/nets/$name" \
    --minutes "$(awk "BEGIN { print ($END - $SECONDS - $MARGIN_S) / 60 }")" --resume
}
