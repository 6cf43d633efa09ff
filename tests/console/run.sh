#!/usr/bin/env bash
# Tests the console in a headless Chromium against a live server. Screenshots are left in
# target/console-screenshots.
#
#   BIN=path/to/placeformer   the program to test
#   CHROMIUM=path             the browser (default: chromium; CI installs Debian's)
#   VENV=dir                  Python environment (default: .venv-tests)
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")"
root=$(cd ../.. && pwd)
PLACEFORMER="$(realpath "${BIN:?names the program to test}")"
export PLACEFORMER

if [ -z "${CHROMIUM:-}" ] && ! command -v chromium >/dev/null; then
  if [ "${CI:-}" != true ]; then
    echo "no chromium here: apt-get install chromium, or name a browser in CHROMIUM" >&2
    exit 1
  fi
  apt-get update -qq
  apt-get install --yes -qq --no-install-recommends chromium >/dev/null
fi

venv="$("$root/tests/python_env.sh")"
export PATH="$venv/bin:$PATH" PYTHONDONTWRITEBYTECODE=1
export SCREENSHOTS="${SCREENSHOTS:-$root/target/console-screenshots}"
settings="$root/clients/python/pyproject.toml"
ruff format --no-cache --check --config "$settings" . ../live_server.py ../facades.py
ruff check --no-cache --config "$settings" . ../live_server.py ../facades.py
python -m pytest -p no:cacheprovider --durations 5 "$@"
