#!/usr/bin/env bash
# Builds the wheel of the Python package, with the program `eddy` in it:
#
#   python/build.sh              for this machine, with its linker
#   python/build.sh --portable   manylinux_2_28 (glibc 2.28 and later), through the linker of zig
#   python/build.sh --portable --target aarch64-unknown-linux-gnu
#
# The wheel is in python/dist. Needs Rust and Python 3.10 or later; installs the build tools into python/.venv.
set -euo pipefail
cd "$(dirname "$0")"
export CARGO_TARGET_DIR="${CARGO_TARGET_DIR:-$PWD/../target}"

portable=
target=x86_64-unknown-linux-gnu
while [ $# -gt 0 ]; do
    case "$1" in
        --portable) portable=yes ;;
        --target) target="$2"; shift ;;
        *) echo "build.sh: found $1, expected --portable or --target TRIPLE" >&2; exit 2 ;;
    esac
    shift
done

python3 -m venv .venv
.venv/bin/pip install --quiet --disable-pip-version-check --requirement requirements-build.txt
PATH="$PWD/.venv/bin:$PATH"

# pip installs what lies in data/scripts beside the interpreter.
mkdir -p data/scripts dist
if [ -n "$portable" ]; then
    cargo zigbuild --release --locked --manifest-path ../Cargo.toml --target "$target.2.28"
    program="$CARGO_TARGET_DIR/$target/release/eddy"
else
    cargo build --release --locked --manifest-path ../Cargo.toml
    program="$CARGO_TARGET_DIR/release/eddy"
fi
if [ "$target" = "$(uname -m)-unknown-linux-gnu" ]; then
    strip -o data/scripts/eddy "$program"
else
    cp "$program" data/scripts/eddy
fi
chmod +x data/scripts/eddy

if [ -n "$portable" ]; then
    maturin build --release --locked --out dist --zig --target "$target" --compatibility manylinux_2_28
else
    maturin build --release --locked --out dist
fi
