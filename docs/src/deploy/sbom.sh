#!/usr/bin/env bash
# Writes the software bill of materials of the program and of the Python package in CycloneDX's format: every crate that they may
# depend on, with version, licence and checksum, also optional ones that their features leave out.
#
#   docs/src/deploy/sbom.sh [FOLDER]     writes FOLDER/eddy.cdx.json and FOLDER/eddy-python.cdx.json [default: target/sbom]
#
# Installs cargo-cyclonedx into a cache of the user's. The same sources give the same bytes.
set -euo pipefail
root=$(cd "$(dirname "$0")/../../.." && pwd)
folder=$(realpath -m "${1:-$root/target/sbom}")
tools="${XDG_CACHE_HOME:-$HOME/.cache}/eddy/tools"
CARGO_TARGET_DIR="$tools/target" cargo install --quiet --locked --root "$tools" cargo-cyclonedx@0.5.9

# cargo-cyclonedx writes beside every crate of the workspace: a copy keeps the checkout as it is.
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cp -r "$root"/{Cargo.toml,Cargo.lock,src,crates,python,README.md} "$work"
mkdir -p "$folder"
# One date and no random serial number.
export SOURCE_DATE_EPOCH="${SOURCE_DATE_EPOCH:-0}"
for crate in . python; do
    name=$(sed -n 's/^name = "\(.*\)"/\1/p' "$work/$crate/Cargo.toml" | head -1)
    "$tools/bin/cargo-cyclonedx" cyclonedx --quiet --format json --target x86_64-unknown-linux-gnu --override-filename "$name.cdx" \
        --manifest-path "$work/$crate/Cargo.toml"
    # References name the folder of the sources.
    sed "s|$work|/eddy|g" "$work/$crate/$name.cdx.json" >"$folder/$name.cdx.json"
done
