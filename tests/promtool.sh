#!/usr/bin/env bash
# Checks what Prometheus will read: its configuration, the alert rules, and the rules' own tests.
# promtool comes from the system. Otherwise it is unpacked from Debian's package into .tools, without
# being installed.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

find_promtool() {
    command -v promtool && return
    [[ -x .tools/promtool ]] && { echo "$PWD/.tools/promtool"; return; }
    command -v apt-get >/dev/null && command -v dpkg-deb >/dev/null || return 1
    local scratch
    scratch=$(mktemp -d)
    if [[ $(id -u) == 0 ]]; then
        chmod 755 "$scratch"
        apt-get update -qq >&2 || true
    fi
    (cd "$scratch" && apt-get download -qq prometheus >&2 2>/dev/null && dpkg-deb -x prometheus_*.deb unpacked) ||
        { rm -rf "$scratch"; return 1; }
    mkdir -p .tools
    mv "$scratch/unpacked/usr/bin/promtool" .tools/
    rm -rf "$scratch"
    echo "$PWD/.tools/promtool"
}

if ! promtool=$(find_promtool); then
    echo "SKIPPED: promtool is not installed and cannot be had from Debian's packages"
    exit 0
fi
cd docker/prometheus
"$promtool" check config prometheus.yml
"$promtool" check rules alerts.yml
"$promtool" test rules alerts_test.yml
