#!/usr/bin/env bash
# Makes several heads on photographs and on towns drawn here, chooses the default among them by
# recall on places that none of them has seen, and records the choice in models/selection.md. This
# takes about a quarter of an hour on two cores.
#
#   make head CAMVID=DIR
#
# CAMVID names a folder with one folder of frames per drive, in order (the four CamVid drives were
# used). It must never be a data set on which recall is reported. Further variables:
#
#   WORK         keeps what is computed, so that an interrupted run can be continued
#   RESULT       where the head and its table are written
#   PLACES, MODEL_FLAGS
#                make a quick trial of this script: fewer places, `--input-size 112x84`
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
if [ -z "${CAMVID:-}" ] || [ ! -d "$CAMVID" ]; then
  echo "say where the photographs are: make head CAMVID=DIR, a folder with one folder of frames in order per drive" >&2
  echo "(the four CamVid drives were used)${CAMVID:+; there is no $CAMVID}" >&2
  exit 1
fi
placeformer=$(realpath "${PLACEFORMER:-target/release/placeformer}")
camvid=$(realpath "$CAMVID")
models=$(realpath models)
result=$(realpath "${RESULT:-models}")
places=${PLACES:-40}
read -ra flags <<<"${MODEL_FLAGS:-}"
if [ -n "${WORK:-}" ]; then
  mkdir -p "$WORK"
  work=$(realpath "$WORK")
else
  work=$(mktemp -d)
  trap 'rm -rf "$work"' EXIT
fi
# From here on paths are relative, so that what a head records of its making is the same everywhere.
cd "$work"

# The tables are written last, so that a town which has them is complete.
town() {
  [ -f "$1/positions.csv" ] || { rm -rf "$1"; "$placeformer" synth --out "$@"; }
}
# Town 7 is the demo's, and towns 11 to 13 are the calibration's.
for seed in 1 2; do town "learnt$seed" --places "$places" --views 2 --seed "$seed"; done
town learnt3 --places $((places * 3 / 2)) --views 3 --seed 3
for seed in 21 22; do town "held$seed" --places "$places" --views 3 --conditions dusk,dusk,overcast --seed "$seed"; done
# This town decides when training stops, and takes no part in the choice.
town validation31 --places "$places" --views 3 --conditions dusk,dusk,overcast --seed 31
for seed in 23 24; do town "distractor$seed" --places "$places" --views 2 --seed "$seed"; done
rm -rf train drives towns
python3 "$models/head_data.py" . --drives "$camvid" \
  --town held21 --town held22 --distractor distractor23 --distractor distractor24

mkdir -p heads results
# With pictures of a third town, every PCA head has lower recall, on photographs and in towns.
# Triplets need them.
for aggregate in mean gem vlad; do
  [ -f "heads/pca-$aggregate.safetensors" ] || "$placeformer" head fit "${flags[@]}" --aggregate "$aggregate" --whitening 0.5 \
    --images train learnt1 learnt2 --out "heads/pca-$aggregate.safetensors"
done
[ -f heads/triplets-mean.safetensors ] || {
  # Nearly every triplet satisfies the paper's margin of 0.01 before the first step, which leaves
  # nothing to learn from.
  "$placeformer" head train "${flags[@]}" --head heads/pca-mean.safetensors --cache cache/pooled --margin 0.3 \
    --patience 15 --drives train/* --dataset csv --root learnt1 --dataset csv --root learnt2 --dataset csv --root learnt3 \
    --validation-dataset csv --validation-root validation31 --out run
  cp run/head.safetensors heads/triplets-mean.safetensors
}

measure() { # result, head, set, further flags
  "$placeformer" eval "${flags[@]}" --head "$2" "${@:4}" --database "$3/database" --queries "$3/queries" \
    --ground-truth "$3/ground_truth.csv" --cache cache/eval --json "results/$1.$3.json"
}
for set in drives towns; do
  measure no-head heads/pca-mean.safetensors "$set" --global mean
  for head in heads/*.safetensors; do
    measure "$(basename "$head" .safetensors)" "$head" "$set"
  done
done
count() { find -L "$@" -name '*.jpg' | wc -l; }
python3 "$models/select_head.py" results --heads heads --sets drives towns --baseline no-head \
  --table "$result/selection.md" --winner "$result/dinov2-vits14-b8.safetensors" \
  --data "Made from $(count train) frames of CamVid stretches and $(count learnt1 learnt2) pictures \
of two drawn towns, the triplets also from $(count learnt3) of a third. Chosen by other stretches of \
the drives, among $(count drives/database) references of which most show places that no query shows, \
and by two other towns, seen from further sides and mostly at dusk, among \
$(count towns/database) references of four towns."
