#!/usr/bin/env bash
# Makes the Python environment of the tests in Python, and prints its folder. It is made anew when
# the list of its packages has changed.
#
#   VENV=dir   where (default: .venv-tests)
set -euo pipefail
root=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
venv="${VENV:-$root/.venv-tests}"
if ! cmp --silent "$root/tests/requirements.txt" "$venv/requirements.txt"; then
  rm -rf "$venv"
  python3 -m venv "$venv"
  "$venv/bin/pip" install --quiet --disable-pip-version-check -r "$root/tests/requirements.txt" >&2
  cp "$root/tests/requirements.txt" "$venv/requirements.txt"
fi
echo "$venv"
