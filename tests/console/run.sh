#!/usr/bin/env bash
# Tests the console in a headless Chromium against a live server. Screenshots are left in
# target/console-screenshots.
#
#   BIN=path/to/placeformer   the program to test
#   CHROMIUM=path             the browser (default: chromium; root gets Debian's package)
#   VENV=dir                  Python environment (default: .venv-tests)
set -euo pipefail
PLACEFORMER="$(realpath "${BIN:?names the program to test}")"
export PLACEFORMER
cd "$(dirname "${BASH_SOURCE[0]}")"
root=$(cd ../.. && pwd)

if [ -z "${CHROMIUM:-}" ] && ! command -v chromium >/dev/null; then
  # In a container, which is where CI and root are, the package can be added.
  if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
    apt-get update -qq
    apt-get install --yes -qq --no-install-recommends chromium >/dev/null
  else
    echo "SKIPPED: no chromium here; apt-get install chromium, or name a browser in CHROMIUM"
    exit 0
  fi
fi

venv="$("$root/tests/python_env.sh")"
export PATH="$venv/bin:$PATH" PYTHONDONTWRITEBYTECODE=1
export SCREENSHOTS="${SCREENSHOTS:-$root/target/console-screenshots}"
settings="$root/clients/python/pyproject.toml"
ruff format --no-cache --check --config "$settings" . ../live_server.py ../facades.py
ruff check --no-cache --config "$settings" . ../live_server.py ../facades.py
python -m pytest -p no:cacheprovider --durations 5 "$@"
