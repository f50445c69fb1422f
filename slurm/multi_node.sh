#!/bin/bash
# One data-parallel run on several nodes: every process steps its share of the environments and takes part in the
# same updates. JAX finds the other processes from what srun sets; nothing else has to be configured.
#
#   sbatch slurm/multi_node.sh game=breakout experiment=constant70_packed seed=1
#   sbatch --nodes=8 slurm/multi_node.sh env.num_envs=1024 ...
#
# env.num_envs counts the environments of the whole run, and each minibatch (env.num_envs / learner.num_minibatches) is
# spread over all devices: it has to be a multiple of their number. docs/scaling.md says what bounds the speed.
#SBATCH --job-name=foajax
#SBATCH --nodes=4
#SBATCH --ntasks-per-node=1   # with GPUs: one task a GPU (JAX gives each task one)
#SBATCH --cpus-per-task=32    # EnvPool steps the task's environments in as many threads
#SBATCH --mem=32G
#SBATCH --time=24:00:00
#SBATCH --requeue
#SBATCH --signal=B:USR1@120   # two minutes before the time limit, to this script
#SBATCH --open-mode=append
#SBATCH --output=slurm-%j.log
# For a GPU, with the extra `cuda`, take the first # of the next line away.
##SBATCH --gpus-per-task=1

# Before the time is up all processes are told to save (one would do: they stop together), and the job queues itself
# again. Exit code 75 means that a process was lost and the others saved, one above 128 that it was a signal which took
# it: the job goes on from there as well, unless it has been restarted 20 times (those at the time limit count too): what
# takes it each time has to be looked at.
trap 'again=1; kill -USR1 "$job"' USR1
srun --kill-on-bad-exit=0 --cpus-per-task="${SLURM_CPUS_PER_TASK:-1}" \
  python -m foajax.train env.num_envs=256 env.threads="${SLURM_CPUS_PER_TASK:-1}" "$@" &
job=$!
wait "$job"
status=$?
if [[ ${again-} ]]; then
  wait "$job" # the first wait ended with the signal
elif ((status != 75 && status <= 128 || ${SLURM_RESTART_COUNT:-0} >= 20)); then
  exit "$status"
fi
scontrol requeue "$SLURM_JOB_ID"
