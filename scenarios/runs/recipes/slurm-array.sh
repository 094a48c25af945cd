#!/usr/bin/env bash
#SBATCH --job-name=cosim
#SBATCH --array=1-8
#SBATCH --cpus-per-task=4
#SBATCH --mem=6G
#SBATCH --time=04:00:00
#SBATCH --requeue
#SBATCH --open-mode=append
#
# A run in shards, one for each task of a job array, which must count from 1. A task that was stopped and is queued
# again goes on where it was. OUT lies on a disk that all nodes share, or is copied together before the merge.
#
#   job=$(sbatch --parsable slurm-array.sh reactive my.py:Mine 7 runs/mine)
#   sbatch --dependency=afterany:$job --wrap "cosim merge runs/mine/shard-* --out runs/mine/whole"
#
# The nodes need processors of one kind, for the same bits: --constraint. Tried without Slurm, by a loop that sets what
# Slurm sets (SLURM_ARRAY_TASK_ID, SLURM_ARRAY_TASK_COUNT, SLURM_CPUS_PER_TASK), stops a task and runs it again.
set -euo pipefail
[ $# -ge 4 ] || { echo "use: sbatch $0 SUITE POLICY SEED OUT [OPTIONS of cosim run]" >&2; exit 2; }
suite=$1 policy=$2 seed=$3 out=$4
shift 4

shard=$out/shard-$SLURM_ARRAY_TASK_ID
again=()
[ ! -e "$shard/run.json" ] || again=(--resume)
mkdir -p "$out"
exec cosim run "$suite" --policy "$policy" --seed "$seed" --shard "$SLURM_ARRAY_TASK_ID/$SLURM_ARRAY_TASK_COUNT" \
  --jobs "${SLURM_CPUS_PER_TASK:-1}" --out "$shard" "$@" "${again[@]}"
