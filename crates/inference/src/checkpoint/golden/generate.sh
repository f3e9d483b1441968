#!/bin/sh
# Writes a golden checkpoint to the folder $1 with the `eddy` in PATH:
#
#     PATH=DIR:$PATH crates/inference/src/checkpoint/golden/generate.sh crates/inference/src/checkpoint/golden/version_2
#
# version_1 was written by eddy at 1fb7837, the last commit of format version 1. Each format version has its own folder;
# those of old versions are never written again.
set -eu
output=$(mkdir -p "$1" && cd "$1" && pwd)
work=$(mktemp -d)
trap 'rm -r "$work"' EXIT
cd "$work"
cat > tiny.toml <<'TOML'
epochs = 1
unroll = [{ share = 1.0, frames = 2 }]
network = { encoder = 3, hidden = 2, channels = [2, 3, 2] }
windows.per_epoch = 64
validation.horizon = 4
TOML
eddy --quiet simulate --preset kinds --particles 300 --scenes 5 --seed 6 --duration 0.5 --output scenes
eddy --quiet train --data scenes --output tiny --seed 1 --config tiny.toml
cp tiny/model.toml tiny/model.safetensors "$output"
