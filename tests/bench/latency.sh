#!/usr/bin/env bash
# Time from the publication of a frame to the reception of its prediction, 2,500 particles at 62.5 Hz on shm: p50, p99,
# p99.9 and the worst, on an idle machine and beside a process per processor that never sleeps, each without and with
# --cpu, --priority and --lock-memory.
#
#   tests/bench/latency.sh [SECONDS] [CPUS]      (default: 600 seconds each, all processors)
#
# EDDY is the program (default: target/release/eddy). Needs the rights that `eddy node --help` names; nothing else should
# run on the machine. Source, node and reader are threads of one process, so that the options apply to all of them.
set -euo pipefail
cd "$(dirname "$0")/../.."
seconds=${1:-600}
cpus=${2:-0-$(($(nproc) - 1))}
eddy=${EDDY:-target/release/eddy}
loads=()
finish() {
    for id in "${loads[@]}"; do kill "$id" 2> /dev/null || true; done
    wait
}
trap finish EXIT

measure() {
    printf '== %s\n' "$1"
    shift
    "$eddy" bench "$@" node --streams 1 --hertz 62.5 --seconds "$seconds" | grep -E 'ms|publication|frames'
}

real_time=(--cpu "$cpus" --priority 50 --lock-memory)
measure "idle"
measure "idle, ${real_time[*]}" "${real_time[@]}"
for ((number = 0; number < $(nproc); number++)); do
    (while :; do :; done) &
    loads+=("$!")
done
measure "loaded"
measure "loaded, ${real_time[*]}" "${real_time[@]}"
