#!/usr/bin/env bash
# Builds the wheel of the Python package, with the program `eddy` in it:
#
#   python/build.sh              for this machine, with its linker
#   python/build.sh --portable   manylinux_2_28 (glibc 2.28 and later), through the linker of zig
#   python/build.sh --portable --target aarch64-unknown-linux-gnu
#
# The wheel is in python/dist. Needs Rust and Python 3.10 or later; installs the build tools outside the checkout. The same
# program gives the same bytes.
set -euo pipefail
python=$(cd "$(dirname "$0")" && pwd)
root=$(dirname "$python")
export CARGO_TARGET_DIR="${CARGO_TARGET_DIR:-$root/target}"

portable=
target="$(uname -m)-unknown-linux-gnu"
while [ $# -gt 0 ]; do
    case "$1" in
        --portable) portable=yes ;;
        --target) target="$2"; shift ;;
        *) echo "build.sh: found $1, expected --portable or --target TRIPLE" >&2; exit 2 ;;
    esac
    shift
done

venv="${XDG_CACHE_HOME:-$HOME/.cache}/eddy/wheel"
[ -x "$venv/bin/python" ] || python3 -m venv "$venv"
"$venv/bin/pip" install --quiet --disable-pip-version-check --requirement "$python/requirements-build.txt"
export PATH="$venv/bin:$PATH"

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
# The module and the program from one build: what both use is compiled once. They are packed without symbols and build id, a hash
# over symbol names: rustc does not choose these the same in every build.
cd "$root"
if [ -n "$portable" ]; then
    cargo zigbuild --release --locked --workspace --target "$target.2.28"
    built="$CARGO_TARGET_DIR/$target/release"
    # rustc's own, for any architecture: that of zig 0.15 is not implemented.
    rust=$(rustc --print sysroot)
    objcopy="$rust/lib/rustlib/$(rustc --print host-tuple)/bin/rust-objcopy"
    strip() { LD_LIBRARY_PATH="$rust/lib" "$objcopy" --strip-all --remove-section=.note.gnu.build-id "$1" "$2"; }
    tag="manylinux_2_28_${target%%-*}"
else
    cargo build --release --locked --workspace
    built="$CARGO_TARGET_DIR/release"
    strip() { command strip --remove-section=.note.gnu.build-id -o "$2" "$1"; }
    tag="linux_${target%%-*}"
fi
strip "$built/lib_eddy.so" "$work/lib_eddy.so"
strip "$built/eddy" "$work/eddy"
chmod 755 "$work/eddy"

# hatchling takes licences from its own folder only.
cp "$root"/LICENSE-* "$python"
trap 'rm -rf "$work" "$python"/LICENSE-*' EXIT
mkdir -p "$python/dist"
cd "$python"
EDDY_BUILT="$work" EDDY_PLATFORM="$tag" python3 -m hatchling build --target wheel --directory dist
