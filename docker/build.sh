#!/usr/bin/env bash
# Builds the image: `docker/build.sh [TAG]`.
#
# Where the public base images are at hand or can be pulled, the server is compiled inside a
# container. Elsewhere it is compiled outside, and put on a base image made from Debian's packages,
# which needs root and debootstrap. BASE and BUILDER choose other images; BINARY names a program
# that is compiled already.
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
    # In a folder of its own, because this program lacks the commands of the feature `lab`.
    cargo build --release --locked --no-default-features --target-dir target/container
    BINARY=target/container/release/placeformer
fi
context=$(mktemp -d)
trap 'rm -rf "$context"' EXIT
install -m 755 "$BINARY" "$context/placeformer"
# A development build carries debug information; function names are kept for backtraces.
strip --strip-debug "$context/placeformer"
docker build --file docker/Dockerfile --target prebuilt --build-arg BASE="$base" --tag "$tag" "$context"
