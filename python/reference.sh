#!/usr/bin/env bash
# Writes the reference of the Python package as HTML, from the docstrings and types of a wheel:
#
#   python/reference.sh python/dist/eddy_surrogates-*.whl [FOLDER]     [default: target/python-reference]
#
# Installs pdoc into a virtual environment outside the checkout.
set -euo pipefail
wheel=$(realpath "$1")
python=$(cd "$(dirname "$0")" && pwd)
folder=$(realpath -m "${2:-$python/../target/python-reference}")
venv="${XDG_CACHE_HOME:-$HOME/.cache}/eddy/python-reference"
[ -x "$venv/bin/python" ] || python3 -m venv "$venv"
"$venv/bin/pip" install --quiet --disable-pip-version-check pdoc==16.0.0 numpy==2.4.6
"$venv/bin/pip" install --quiet --disable-pip-version-check --force-reinstall --no-deps "$wheel"
cd "$(mktemp -d)"
"$venv/bin/python" -m pdoc --docformat markdown --output-directory "$folder" eddy
rmdir "$PWD"
echo "$folder/eddy.html"
