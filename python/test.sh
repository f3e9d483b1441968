#!/usr/bin/env bash
# Tests the Python package with a library that cargo has built:
#
#   cargo build --release --workspace
#   python/test.sh target/release/lib_eddy.so [PYTEST ARGUMENTS]
#
# Checks the types against the library (mypy's stubtest), then runs the tests, the README's example and the notebook. Installs
# pinned requirements into a virtual environment outside the checkout.
set -euo pipefail
library=$(realpath "$1")
shift
python=$(cd "$(dirname "$0")" && pwd)
venv="${XDG_CACHE_HOME:-$HOME/.cache}/eddy/python"
[ -x "$venv/bin/python" ] || python3 -m venv "$venv"
"$venv/bin/pip" install --quiet --disable-pip-version-check --requirement "$python/requirements-test.txt"

# The package as a wheel lays it out.
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cp -r "$python/eddy" "$work/eddy"
cp "$library" "$work/eddy/_eddy.abi3.so"
export PYTHONPATH="$work" PYTHONDONTWRITEBYTECODE=1
cd "$work"

"$venv/bin/python" -m mypy --strict --no-error-summary --cache-dir "$work/mypy" -p eddy
"$venv/bin/python" -m mypy.stubtest eddy
"$venv/bin/python" -m pytest --quiet -p no:cacheprovider "$python/tests" "$@"
