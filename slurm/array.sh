#!/bin/bash
# The paper's comparison as one job array: 7 models x 3 games x 3 seeds = 63 runs, as long as those of docs/results.md,
# each in a directory of its own (runs/<game>-<experiment>-s<seed>). Submitted from the checkout, or from anywhere with
# foajax installed, with the environment activated:
#
#   sbatch slurm/array.sh                                 # all of it, with this package's learner
#   sbatch slurm/array.sh learner=paper network=a3c 'run=runs/paper/${game}-${name}-s${seed}'  # with Table III's
#   sbatch --array=0-62%8 slurm/array.sh                  # at most 8 at a time
#   sbatch slurm/array.sh train.env_steps=20000000        # further words go to every run
#   python -m foajax.status runs/                         # what they are doing
#
# Submitting it again is safe: a finished run ends at once, an unfinished one goes on from its newest checkpoint,
# and one that is still running is left alone ("in use").
#SBATCH --job-name=foajax
#SBATCH --array=0-62
#SBATCH --ntasks=1
#SBATCH --cpus-per-task=8     # EnvPool steps games in as many threads; training takes about two more
#SBATCH --mem=8G
#SBATCH --time=24:00:00
#SBATCH --requeue
#SBATCH --signal=B:USR1@120   # two minutes before the time limit, to this script
#SBATCH --open-mode=append
#SBATCH --output=slurm-%A_%a.log
# For a GPU, with the extra `cuda`, take the first # of the next line away.
##SBATCH --gpus-per-task=1

models=(nonfoa {constant50_sub1,constant50_sub2,constant70,decreasing,constant70_p,decreasing_p}_packed)
games=(breakout pong beam_rider)
seeds=(0 1 2)

i=${SLURM_ARRAY_TASK_ID:?submit this with sbatch}
experiment=${models[i % ${#models[@]}]}
game=${games[i / ${#models[@]} % ${#games[@]}]}
seed=${seeds[i / (${#models[@]} * ${#games[@]})]}
steps=3_000_000
[[ $game == pong ]] && steps=1_500_000

# Before the time is up the run is told to save, and the array task queues itself again.
trap 'again=1; kill -USR1 "$run"' USR1
srun --cpus-per-task="${SLURM_CPUS_PER_TASK:-1}" \
  python -m foajax.train experiment="$experiment" game="$game" seed="$seed" train.env_steps="$steps" \
  env.threads="${SLURM_CPUS_PER_TASK:-1}" "$@" &
run=$!
wait "$run"
status=$?
if [[ ${again-} ]]; then
  wait "$run" # the first wait ended with the signal
  scontrol requeue "${SLURM_ARRAY_JOB_ID}_${SLURM_ARRAY_TASK_ID}"
  exit 0
fi
exit "$status"
