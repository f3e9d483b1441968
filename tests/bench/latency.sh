#!/usr/bin/env bash
# Time from the publication of a frame to the reception of its prediction, 2,500 particles at 62.5 Hz on shm: p50, p99,
# p99.9 and the worst, on idle processors and beside a process per processor that never sleeps, each without and with
# --cpu, --priority and --lock-memory.
#
#   tests/bench/latency.sh [SECONDS] [CPUS]      one after the other, 600 seconds each on all processors by default
#   tests/bench/latency.sh SECONDS --at-once CPUS CPUS CPUS CPUS
#                                                the four at the same time, each on processors of its own, such as 8,9
#
# EDDY_LAB is the program (default: target/release/eddy-lab). Needs the rights that `eddy node --help` names; nothing else should
# run on these processors. Source, node and reader are threads of one process, so that the options apply to all of them.
# Ends with 1 if one of the four could not be measured.
set -euo pipefail
cd "$(dirname "$0")/../.."
seconds=${1:-600}
eddy_lab=${EDDY_LAB:-target/release/eddy-lab}
work=$(mktemp -d)
started=()
finish() {
    for id in "${started[@]}"; do kill "$id" 2> /dev/null || true; done
    wait
    rm -rf "$work"
}
trap finish EXIT

# One number per line from a list such as 0-2,5.
processors() {
    local range
    for range in ${1//,/ }; do seq "${range%-*}" "${range#*-}"; done
}

# load CPUS: a process per processor that never sleeps.
load() {
    local cpu
    for cpu in $(processors "$1"); do
        taskset --cpu-list "$cpu" bash -c 'while :; do :; done' &
        started+=("$!")
    done
}

# measure NAME CPUS [OPTION...]
measure() {
    local name=$1 cpus=$2 log
    shift 2
    log=$(mktemp -p "$work")
    if taskset --cpu-list "$cpus" "$eddy_lab" bench "$@" node --streams 1 --hertz 62.5 --seconds "$seconds" > "$log" 2>&1; then
        printf '== %s, processors %s\n%s\n' "$name" "$cpus" "$(grep -E 'ms|publication|frames' "$log")"
    else
        printf '== %s, processors %s: not measured\n%s\n' "$name" "$cpus" "$(cat "$log")"
        return 1
    fi
}

# real_time NAME CPUS
real_time() {
    local options=(--cpu "$2" --priority 50 --lock-memory)
    measure "$1, ${options[*]}" "$2" "${options[@]}"
}

failed=0
if [ "${2:-}" = --at-once ]; then
    [ $# = 6 ] || { echo "latency.sh: found $(($# - 2)) lists of processors after --at-once, expected 4" >&2; exit 2; }
    load "$5"
    load "$6"
    runs=()
    measure "idle" "$3" & runs+=("$!")
    real_time "idle" "$4" & runs+=("$!")
    measure "loaded" "$5" & runs+=("$!")
    real_time "loaded" "$6" & runs+=("$!")
    started+=("${runs[@]}")
    for run in "${runs[@]}"; do wait "$run" || failed=1; done
else
    cpus=${2:-0-$(($(nproc) - 1))}
    measure "idle" "$cpus" || failed=1
    real_time "idle" "$cpus" || failed=1
    load "$cpus"
    measure "loaded" "$cpus" || failed=1
    real_time "loaded" "$cpus" || failed=1
fi
exit "$failed"
