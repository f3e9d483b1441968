#!/usr/bin/env bash
# Writes the software bill of materials of the programs and of the Python package in CycloneDX's format: every crate that is compiled
# into them with the features of the build, with version, licence and checksum.
#
#   docs/src/deploy/sbom.sh [FOLDER]     writes eddy-surrogates.cdx.json, eddy-lab.cdx.json and eddy-python.cdx.json into FOLDER [default: target/sbom]
#
# Installs cargo-cyclonedx into a cache of the user's; needs Python 3. The same sources give the same bytes.
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
target=x86_64-unknown-linux-gnu
for crate in . crates/lab python; do
    name=$(sed -n 's/^name = "\(.*\)"/\1/p' "$work/$crate/Cargo.toml" | head -1)
    "$tools/bin/cargo-cyclonedx" cyclonedx --quiet --format json --target "$target" --override-filename "$name.cdx" \
        --manifest-path "$work/$crate/Cargo.toml"
    # cargo-cyclonedx also lists optional crates that no feature enables, and those that only run during the build.
    cargo tree --quiet --locked --manifest-path "$work/Cargo.toml" --package "$name" --target "$target" \
        --edges normal,no-proc-macro --prefix none --format '{p}' >"$work/compiled"
    # References name the folder of the sources.
    python3 - "$work/$crate/$name.cdx.json" "$work/compiled" <<'PYTHON' | sed "s|$work|/eddy|g" >"$folder/$name.cdx.json"
import json, sys

bill = json.load(open(sys.argv[1]))
# "burn v0.22.1 (/path)"
compiled = {tuple(line.split()[:2]) for line in open(sys.argv[2]) if line.strip()}
listed = {(part["name"], "v" + part["version"]) for part in bill["components"]}
own = bill["metadata"]["component"]
missing = compiled - listed - {(own["name"], "v" + own["version"])}
if missing:
    sys.exit(f"sbom.sh: not in the list of cargo-cyclonedx: {sorted(missing)}")
bill["components"] = [part for part in bill["components"] if (part["name"], "v" + part["version"]) in compiled]
kept = {part["bom-ref"] for part in bill["components"]} | {own["bom-ref"]}
bill["dependencies"] = [
    {**entry, "dependsOn": [ref for ref in entry["dependsOn"] if ref in kept]} if "dependsOn" in entry else entry
    for entry in bill["dependencies"] if entry["ref"] in kept
]
json.dump(bill, sys.stdout, indent=2)
print()
PYTHON
done
