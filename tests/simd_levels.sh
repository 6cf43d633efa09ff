#!/usr/bin/env bash
# Runs the tests that compare with stored outputs at every level of SIMD that this CPU has, so that
# what the service falls back to on an older CPU keeps to the same tolerances.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
bin=${BIN:-target/debug/placeformer}
ran=0
for level in scalar avx2 avx512 amx; do
    if ! refusal=$(PLACEFORMER_SIMD=$level "$bin" model info 2>&1 >/dev/null); then
        case $refusal in
            *'goes no further than'*) echo "left out on this CPU: $level" && continue ;;
            *) printf '%s\n' "$refusal" >&2 && exit 1 ;;
        esac
    fi
    echo "level $level"
    PLACEFORMER_SIMD=$level cargo nextest run --locked --package placeformer \
        --package placeformer-vision --test recognition --lib -E 'test(golden)'
    ran=$((ran + 1))
done
[ "$ran" -gt 0 ]
