#!/usr/bin/env bash
# Fits the default model's calibration again, on street photographs and on towns drawn here, with
# mapped and unmapped places of both.
#
#   make calibration CAMVID=DIR
#
# CAMVID names a folder with one folder of frames per drive, in order (the four CamVid drives were
# used). It must never be a data set on which recall is reported. The program contains the new
# calibration from its next build on. Further variables:
#
#   MODEL_FLAGS  another model, such as `--difference FILE --head FILE`
#   OUT          where its calibration is written
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
placeformer=${PLACEFORMER:-target/release/placeformer}
if [ -z "${CAMVID:-}" ] || [ ! -d "$CAMVID" ]; then
  echo "say where the photographs are: make calibration CAMVID=DIR, a folder with one folder of frames in order per drive" >&2
  echo "(the four CamVid drives were used)${CAMVID:+; there is no $CAMVID}" >&2
  exit 1
fi
read -ra flags <<<"${MODEL_FLAGS:-}"
out=$(realpath -m "${OUT:-models/dinov2-vits14-b8.calibration.json}")
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
# Town 1 is among the pictures that the head was fitted on, and town 7 is the demo's.
for town in 11 12 13; do
  "$placeformer" synth --out "$work/town$town" --places 40 --views 2 --seed "$town"
done
python3 models/calibration_data.py "$work/data" --drives "$CAMVID" \
  --town "$work/town11" --town "$work/town12" --stranger "$work/town13"
"$placeformer" eval calibrate "${flags[@]}" --dataset csv --root "$work/data" \
  --data-name "four CamVid drives and two drawn towns, with stretches and a town that are not mapped" \
  --out "$out"
