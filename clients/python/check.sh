#!/usr/bin/env bash
# Checks the Python client: formatting, lints, types; its wheel; tests and examples with that wheel
# against a live server.
#
#   BIN=path/to/placeformer   the program to test against
#   VENV=dir                  Python environment (default: .venv-tests)
set -euo pipefail
PLACEFORMER="$(realpath "${BIN:?names the program to test against}")"
export PLACEFORMER
cd "$(dirname "${BASH_SOURCE[0]}")"
root=$(cd ../.. && pwd)
venv="$("$root/tests/python_env.sh")"
export PATH="$venv/bin:$PATH" PYTHONDONTWRITEBYTECODE=1

settings="$PWD/pyproject.toml"
ruff format --no-cache --check --config "$settings" . "$root/examples"
ruff check --no-cache --config "$settings" . "$root/examples"
mypy --cache-dir "$venv/mypy"

rm -rf "$venv/wheel"
python -m build --wheel --no-isolation --outdir "$venv/wheel" . >"$venv/build.log" 2>&1 || {
  cat "$venv/build.log"
  exit 1
}
pip install --quiet --disable-pip-version-check --no-deps --force-reinstall "$venv"/wheel/*.whl
python -m pytest -p no:cacheprovider --durations 5 "$@"
