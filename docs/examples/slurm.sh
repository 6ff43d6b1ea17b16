#!/usr/bin/env bash
# An experiment on a Slurm cluster: an array of shards, and a job that merges them once all are done.
#
#   docs/examples/slurm.sh 8 runs/maze maze --seeds 64 --episodes 500
#
# plays `python -m jaxdyna.experiments.maze` with these flags in 8 shards and leaves one record in
# runs/maze, as if it had been played at once. Run it again to go on with shards that did not end.
# What sbatch is to be told beside it (partition, time, cores) stands in SBATCH_FLAGS.
set -euo pipefail

if [ $# -lt 3 ]; then
  echo "usage: $0 SHARDS OUT EXPERIMENT [FLAG ...]" >&2
  exit 2
fi
of=$1 out=$2 experiment=$3
shift 3
read -r -a said <<< "${SBATCH_FLAGS:---cpus-per-task=2 --mem=8G}"
python=${PYTHON:-$(command -v python)}
mkdir -p "$out/parts"

# A shard that was begun goes on; one that is whole has nothing left to play.
# shellcheck disable=SC2016  # the job fills these in
shard='part=$out/parts/$SLURM_ARRAY_TASK_ID-of-$of
if [ -e "$part/results.json" ] && [ ! -e "$part/checkpoints" ]; then exit 0; fi
resume=(); if [ -e "$part/checkpoints" ]; then resume=(--resume); fi
exec "$python" -m "jaxdyna.experiments.$experiment" "$@" \
  --shard "$SLURM_ARRAY_TASK_ID/$of" --out "$part" "${resume[@]}"'
script() { # BODY [FLAG ...]
  printf '#!/usr/bin/env bash\nset -euo pipefail\n'
  printf '%s=%q\n' out "$out" of "$of" python "$python" experiment "$experiment"
  printf 'set --'
  if [ $# -gt 1 ]; then printf ' %q' "${@:2}"; fi
  printf '\n%s\n' "$1"
}

array=$(script "$shard" "$@" | sbatch --parsable "${said[@]}" --array="1-$of" --requeue \
  --job-name="$experiment" --output="$out/parts/%a.log" --open-mode=append)
parts=$(printf '"$out/parts/%d-of-$of" ' $(seq "$of"))
merge=$(script "exec \"\$python\" -m jaxdyna.experiments.merge $parts --out \"\$out\"" |
  sbatch --parsable --dependency="afterok:${array%%;*}" --job-name="merge-$experiment" \
    --output="$out/parts/merge.log")
echo "array ${array%%;*} plays $of shards into $out/parts; job ${merge%%;*} merges them into $out"
