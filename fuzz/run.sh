#!/usr/bin/env bash
# Runs fuzz targets with AddressSanitizer: `fuzz/run.sh SECONDS [TARGET...]`; without names, all of
# them.
# A finding stops the run and leaves its input in fuzz/artifacts/ (`cargo fuzz run TARGET FILE`
# repeats it).
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")"
seconds=$1
shift
[[ -x ../.venv/bin/cargo-fuzz ]] && PATH="$(cd ../.venv/bin && pwd):$PATH"
# Sanitizers are unstable options, and the project uses the stable toolchain only.
export RUSTC_BOOTSTRAP=1
if [[ $# == 0 ]]; then
    mapfile -t targets < <(cargo fuzz list --fuzz-dir .)
else
    targets=("$@")
fi
# An input may be as long as an image of the service (`image.max_bytes`), because a cap would hide
# what long inputs cost. libFuzzer grows its inputs step by step, so this slows nothing down.
max_len=$((20 << 20))
python3 seed_corpus.py
for target in "${targets[@]}"; do
    printf '\n==== %s for %s s\n' "$target" "$seconds"
    cargo fuzz run --fuzz-dir . "$target" "corpus/$target" -- \
        -max_total_time="$seconds" -rss_limit_mb=2048 -timeout=20 -max_len="$max_len" -print_final_stats=1 -verbosity=1
done
printf '\n%d passed, 0 failed\n' "${#targets[@]}"
