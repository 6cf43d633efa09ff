#!/usr/bin/env bash
# Trains the default model on photographs of a city, measures it on a quarter of the city that
# training never saw, and calibrates it. This takes about two hours on two cores.
#
#   make model LONDON=DIR CAMVID=DIR
#
# LONDON names a data set with database/, queries/, ground_truth.csv and positions.csv with headings
# (the western part of MSLS London was used). CAMVID names a folder with one folder of frames per
# drive, in order (the four CamVid drives were used); the calibration is fitted to them. Neither may
# be a data set on which recall is reported. Further variables:
#
#   WORK         keeps what is computed, so that an interrupted run is continued
#   RESULT       where the difference, the head, the calibration and the table are written
#   TRAIN_FLAGS, MODEL_FLAGS
#                change the recipe, or make a quick trial of this script: `--steps 3`,
#                `--input-size 224x168`
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
usage="say where the photographs are: make model LONDON=DIR CAMVID=DIR"
for name in LONDON CAMVID; do
  if [ -z "${!name:-}" ] || [ ! -d "${!name}" ]; then
    echo "$usage${!name:+; there is no ${!name}}" >&2
    exit 1
  fi
done
placeformer=$(realpath "${PLACEFORMER:-target/release/placeformer}")
london=$(realpath "$LONDON")
camvid=$(realpath "$CAMVID")
models=$(realpath models)
result=${RESULT:-models}
mkdir -p "$result"
result=$(realpath "$result")
read -ra train_flags <<<"${TRAIN_FLAGS:-}"
read -ra model_flags <<<"${MODEL_FLAGS:-}"
if [ -n "${WORK:-}" ]; then
  mkdir -p "$WORK"
  work=$(realpath "$WORK")
else
  work=$(mktemp -d)
  trap 'rm -rf "$work"' EXIT
fi
# From here on paths are relative, so that what the files record of their making is the same
# everywhere.
cd "$work"
ln -sfn "$london" london

"$placeformer" train --recipe streets --dataset csv --root london --by-parts --token-cache tokens \
  --out run "${model_flags[@]}" "${train_flags[@]}"

name=dinov2-vits14-streets
mkdir -p results
measure() { # result, further flags
  "$placeformer" eval --dataset csv --root london --hold-out report --cache eval \
    "${model_flags[@]}" --json "results/$1.json" "${@:2}" | tee "results/$1.txt"
}
measure stock
measure fitted --head run/start.safetensors
measure trained --difference run/difference.safetensors --head run/head.safetensors

cp run/difference.safetensors "$result/$name.difference.safetensors"
cp run/head.safetensors "$result/$name.head.safetensors"
cp run/settings.json "$result/$name.settings.json"
{
  echo "# The model on the quarter of its city that training never saw"
  for run in stock fitted trained; do
    printf '\n## %s\n\n```\n' "$run"
    cat "results/$run.txt"
    printf '```\n'
  done
} >"$result/$name.md"

trained="--difference $work/run/difference.safetensors --head $work/run/head.safetensors"
CAMVID="$camvid" PLACEFORMER="$placeformer" OUT="$result/$name.calibration.json" \
  MODEL_FLAGS="${model_flags[*]} $trained" "$models/make_calibration.sh"
