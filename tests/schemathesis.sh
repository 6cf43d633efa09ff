#!/usr/bin/env bash
# Sends a live server requests that are derived from its own OpenAPI document. It must not answer with
# a 5xx, nor with anything that the document does not describe. The script makes its own Python
# environment. The server listens on a free loopback port, with its data in a temporary directory.
#
#   BIN=path/to/placeformer   the program to test (default: build and use target/debug/placeformer)
#   VENV=dir                  Python environment (default: .venv)
#   MAX_EXAMPLES=n            cases per operation (default: 15)
set -euo pipefail
cd "$(dirname "$0")/.."

if [ -z "${BIN:-}" ]; then
  cargo build --quiet --locked
  BIN="${CARGO_TARGET_DIR:-target}/debug/placeformer"
fi
VENV="${VENV:-.venv}"
VERSION=4.32.5
if ! "$VENV/bin/python" -c "import importlib.metadata as m, sys; sys.exit(m.version('schemathesis') != '$VERSION')" 2>/dev/null; then
  python3 -m venv "$VENV"
  "$VENV/bin/pip" install --quiet --disable-pip-version-check "schemathesis==$VERSION"
fi

work="$(mktemp -d)"
server=
finish() {
  if [ -n "$server" ]; then
    kill "$server" 2>/dev/null || true
    wait "$server" 2>/dev/null || true
  fi
  rm -rf "$work"
}
trap finish EXIT

# A photo may take long on a busy machine, which is not what is tested here.
export PLACEFORMER_PIPELINE__DEADLINE_MS=120000 PLACEFORMER_PIPELINE__MAX_WAIT_MS=60000
"$BIN" serve --listen 127.0.0.1:0 --data "$work/data" >"$work/address" 2>"$work/log" &
server=$!
url=
for _ in $(seq 600); do
  url="$(sed -n 's/^listening on //p' "$work/address")"
  if [ -n "$url" ] && "$BIN" healthcheck --server "$url" >/dev/null 2>&1; then break; fi
  if ! kill -0 "$server" 2>/dev/null; then cat "$work/log" >&2; exit 1; fi
  sleep 0.5
done
"$BIN" healthcheck --server "$url"

"$BIN" synth --out "$work/town" --places 1 --views 1 --size 160x120 >/dev/null
"$BIN" import "$work/town/database" --map town --server "$url" >/dev/null
photo=("$work"/town/queries/*.jpg)
reference="$(curl -sf "$url/references?map=town" | sed -n 's/.*"id":"\([^"]*\)".*/\1/p')"
export PYTHONPATH=tests SCHEMATHESIS_HOOKS=schemathesis_hooks

# Random bytes satisfy the schema of an image body but are no image, so that the check
# `positive_data_acceptance` cannot hold for uploads.
run() {
  "$VENV/bin/st" run "$url/openapi.json" --checks all --exclude-checks "$1" --phases examples,coverage,fuzzing \
    --max-examples "${MAX_EXAMPLES:-15}" --seed 1 --no-shrink --continue-on-failure
}

status=0
echo "== as generated"
run positive_data_acceptance || status=$?
# Once more with real photos, which the generator's own validation takes for malformed bodies.
echo "== with real photos, maps and references"
PHOTO="${photo[0]}" MAP=town REFERENCE="$reference" run positive_data_acceptance,negative_data_rejection || status=$?

if ! kill -0 "$server" 2>/dev/null; then
  echo "the server did not survive" >&2
  status=1
fi
if grep -E "panicked|ERROR" "$work/log" >&2; then status=1; fi
exit "$status"
