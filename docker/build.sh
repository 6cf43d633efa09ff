#!/usr/bin/env bash
# Builds the image: `docker/build.sh [TAG]`.
#
# With the public base images at hand (here already, or to be pulled) it compiles inside. Otherwise it compiles outside,
# makes a base from Debian's packages (root and debootstrap) and puts the binary on it. BASE and BUILDER choose other
# images, BINARY a binary that is there already.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
tag=${1:-placeformer:local}
builder=${BUILDER:-rust:1.95-bookworm}
# Without the buildx plug-in the client can only use the classic builder.
docker buildx version >/dev/null 2>&1 || export DOCKER_BUILDKIT=0

have() { docker image inspect "$1" >/dev/null 2>&1 || timeout 300 docker pull --quiet "$1" >/dev/null 2>&1; }

base=${BASE:-debian:bookworm-slim}
if ! have "$base"; then
    base=placeformer-base:bookworm
    docker image inspect "$base" >/dev/null 2>&1 || docker/debian-base.sh "$base"
fi
if [[ -z ${BINARY:-} ]] && have "$builder"; then
    exec docker build --file docker/Dockerfile --build-arg BASE="$base" --build-arg BUILDER="$builder" --tag "$tag" .
fi
if [[ -z ${BINARY:-} ]]; then
    echo "$builder cannot be had: compiling outside the container"
    cargo build --release --locked
    BINARY=target/release/placeformer
fi
context=$(mktemp -d)
trap 'rm -rf "$context"' EXIT
install -m 755 "$BINARY" "$context/placeformer"
strip "$context/placeformer"
docker build --file docker/Dockerfile --target prebuilt --build-arg BASE="$base" --tag "$tag" "$context"
