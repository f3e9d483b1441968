#!/usr/bin/env bash
# Makes everything that a release consists of, and uploads nothing:
#
#   docs/src/deploy/release.sh VERSION FOLDER [--native]
#
# FOLDER gets the wheels for x86-64 and aarch64 (glibc 2.28 or later), the Debian package of this machine, the bills of materials, the
# text of the tag and SHA256SUMS. With --native, the wheel is that of this machine alone: minutes instead of two hours.
#
# Before it: VERSION in Cargo.toml; the entries of docs/changes/ moved to CHANGELOG.md below a heading
# "## VERSION - DATE"; everything committed. It refuses anything else, and FOLDER if it exists.
set -euo pipefail
usage() { echo "release.sh: $1; usage: release.sh VERSION FOLDER [--native]" >&2; exit 2; }
[ $# -ge 2 ] || usage "found $# arguments"
version=$1
folder=$(realpath -m "$2")
native=${3:-}
[ -z "$native" ] || [ "$native" = --native ] || usage "found $native"
root=$(cd "$(dirname "$0")/../../.." && pwd)
cd "$root"
export CARGO_TARGET_DIR="${CARGO_TARGET_DIR:-$root/target}"

refuse() { echo "release.sh: $1" >&2; exit 1; }
found=$(sed -n 's/^version = "\(.*\)"/\1/p' Cargo.toml | head -1)
[ "$found" = "$version" ] || refuse "Cargo.toml: version: found $found, expected $version"
text=$(awk -v heading="## $version - 20" 'index($0, heading) == 1 { on = 1; next } /^## / { on = 0 } on' CHANGELOG.md)
[ -n "$text" ] || refuse "CHANGELOG.md: found no heading \"## $version - DATE\""
left=$(find docs/changes -name '*.md' ! -name README.md)
[ -z "$left" ] || refuse "docs/changes: found $left, expected nothing: move the entries to CHANGELOG.md"
[ -z "$(git status --porcelain)" ] || refuse "the checkout: found changes, expected that all is committed"
[ ! -e "$folder" ] || refuse "$folder: exists"
[ ! -e "$folder.part" ] || refuse "$folder.part: exists, of a release that failed"

step() { printf '== %s (%ss)\n' "$1" "$SECONDS"; }
work="$folder.part"
mkdir -p "$work"
step "crates"
cargo publish --workspace --locked --dry-run --quiet
step "programs"
cargo build --release --locked --workspace
step "Debian package"
docs/src/deploy/debian.sh "$CARGO_TARGET_DIR/release/eddy" "$work"
step "bills of materials"
docs/src/deploy/sbom.sh "$work"
step "wheels"
rm -f python/dist/*.whl
if [ -n "$native" ]; then
    python/build.sh
else
    for target in x86_64 aarch64; do python/build.sh --portable --target "$target-unknown-linux-gnu"; done
fi
cp python/dist/*.whl "$work"
step "text and checksums"
printf 'eddy %s\n\n%s\n' "$version" "$text" >"$work/tag.txt"
(cd "$work" && sha256sum -- * >SHA256SUMS)
mv "$work" "$folder"
cat <<TEXT
$folder
To release:
  git tag --annotate --cleanup=whitespace --file $folder/tag.txt v$version && git push origin v$version
  cargo publish --workspace --locked
  twine upload $folder/*.whl
and attach the files of the folder to the release.
TEXT
