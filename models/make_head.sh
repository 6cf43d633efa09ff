#!/usr/bin/env bash
# Makes the default head again: half-whitened PCA on photographs and on streets drawn here, without labels.
# CAMVID names a folder of street photographs (the four CamVid drives were used); never a set that recall is reported on.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
placeformer=${PLACEFORMER:-target/release/placeformer}
camvid=${CAMVID:-../shared/data/camvid}
[ -d "$camvid" ] || { echo "no photographs in $camvid; set CAMVID" >&2; exit 1; }
streets=$(mktemp -d)
trap 'rm -rf "$streets"' EXIT
"$placeformer" synth --out "$streets" --places 60 --views 2 --seed 1
"$placeformer" head fit --images "$camvid" "$streets" --out models/dinov2-vits14-b8.safetensors
