#!/usr/bin/env bash
# Runs everything that CI runs, one make target after the other. It stops at the first failure and
# says how long each step took.
set -uo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
logs=target/test-logs
mkdir -p "$logs"
summary=()
began=$SECONDS

report() {
    printf '\n%-14s %8s  %s\n' step seconds outcome
    printf '%s\n' "${summary[@]}"
    printf '%-14s %8d\n\n' total $((SECONDS - began))
    # Repeats the test runner's closing line here, so that the end of the output says how many
    # tests ran.
    sed 's/\x1b\[[0-9;]*m//g' "$logs/unit.log" 2>/dev/null | grep -E '^ +Summary \[' || true
}

for step in "$@"; do
    printf '\n==== make %s\n' "$step"
    start=$SECONDS
    if "${MAKE:-make}" --no-print-directory "$step" 2>&1 | tee "$logs/$step.log"; then
        outcome=ok
        grep -q '^SKIPPED' "$logs/$step.log" && outcome=$(grep -m1 '^SKIPPED' "$logs/$step.log")
        summary+=("$(printf '%-14s %8d  %s' "$step" $((SECONDS - start)) "$outcome")")
    else
        summary+=("$(printf '%-14s %8d  %s' "$step" $((SECONDS - start)) FAILED)")
        report
        printf 'make %s failed; its output is in %s/%s.log\n' "$step" "$logs" "$step" >&2
        exit 1
    fi
done
report
