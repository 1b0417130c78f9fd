#!/bin/bash
# A large simulation as a SLURM array: every task traces its share of the units, the one that finishes last writes the
# file. Submit:   sbatch docs/slurm_array.sh big.toml big.h5
# The folder must be seen by all nodes, with this program in .venv. SLURM's SIGTERM, a minute before the time is out,
# ends a task with code 75; its finished units are kept, and the same submission again, or a requeue, goes on there.
# If a task was lost for good:   helio resume big.h5   traces what is missing and writes the file.
#SBATCH --array=1-16
#SBATCH --cpus-per-task=8
#SBATCH --mem=4G
#SBATCH --time=02:00:00
#SBATCH --signal=TERM@60
#SBATCH --requeue
set -euo pipefail
srun .venv/bin/helio simulate "$1" -o "$2" \
  --shard "$SLURM_ARRAY_TASK_ID/$SLURM_ARRAY_TASK_MAX" --workers "$SLURM_CPUS_PER_TASK"
