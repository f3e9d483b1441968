#!/usr/bin/env bash
# Tests the wheel that `build.sh` made, in an environment of its own, as a user installs it:
#
#   python/test.sh python/dist/eddy_surrogates-*.whl [PYTEST ARGUMENTS]
#
# Checks the types against the installed package (mypy's stubtest), then runs the tests, the README's example and the notebook.
# Installs pinned requirements into a virtual environment outside the checkout.
set -euo pipefail
wheel=$(realpath "$1")
shift
python=$(cd "$(dirname "$0")" && pwd)
venv="${XDG_CACHE_HOME:-$HOME/.cache}/eddy/python"
[ -x "$venv/bin/python" ] || python3 -m venv "$venv"
"$venv/bin/pip" install --quiet --disable-pip-version-check --requirement "$python/requirements-test.txt"
"$venv/bin/pip" install --quiet --disable-pip-version-check --force-reinstall --no-deps "$wheel"

# Not in the checkout, whose folder `eddy` has no library.
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
export PYTHONDONTWRITEBYTECODE=1
cd "$work"

"$venv/bin/eddy" --version
"$venv/bin/python" -m mypy --strict --no-error-summary --cache-dir "$work/mypy" -p eddy
"$venv/bin/python" -m mypy.stubtest eddy
"$venv/bin/python" -m pytest --quiet -p no:cacheprovider "$python/tests" "$@"
