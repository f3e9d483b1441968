#!/usr/bin/env bash
# Replays 2,500 particles at 250 Hz through a node into a recording, on shm and on zenoh, and samples the memory
# of the three processes: no message may be lost, and memory must be constant after the first minute.
#
#   tests/bench/steady.sh [SECONDS] [TRANSPORT...]      (default: 600 seconds each on shm and zenoh)
#
# Prints a line every ten seconds (time in s; anonymous and total memory of replay, node and record in MB), then the
# counters of each process. EDDY is the program (default: target/release/eddy). The bag grows by 22 MB/s and is deleted.
set -euo pipefail
cd "$(dirname "$0")/../.."
seconds=${1:-600}
shift || true
transports=("$@")
[ ${#transports[@]} -gt 0 ] || transports=(shm zenoh)
eddy=${EDDY:-target/release/eddy}
folder=$(mktemp -d "${TMPDIR:-/var/tmp}/eddy_steady.XXXXXX")
pids=()
finish() {
    for pid in "${pids[@]}"; do kill -INT "$pid" 2> /dev/null || true; done
    wait || true
    rm -rf "$folder"
}
trap finish EXIT

memory() {
    awk '/^VmRSS/ { all = $2 } /^RssAnon/ { own = $2 } END { printf " %6.1f %6.1f", own / 1024, all / 1024 }' \
        "/proc/$1/status"
}

for transport in "${transports[@]}"; do
    topic=/steady_$$
    echo "$transport:"
    "$eddy" record "$transport:$topic/particles" "$transport:$topic/prediction" \
        --output "$folder/$transport" > "$folder/record.txt" 2>&1 &
    record=$!
    "$eddy" node --input "$transport:$topic/particles" --output "$transport:$topic/prediction" \
        --reliability block > "$folder/node.txt" 2>&1 &
    node=$!
    pids=("$record" "$node")
    # The sample's frames are 16 ms apart: four times as fast is 250 Hz. Both subscribers must be ready for the first one.
    "$eddy" replay bags/sample --loop --rate 4 --to "$transport" --wait-for 2 \
        --topics /particles --remap "/particles:=$topic/particles" > "$folder/replay.txt" 2>&1 &
    replay=$!
    pids+=("$replay")
    for ((elapsed = 10; elapsed <= seconds; elapsed += 10)); do
        sleep 10
        printf '%5d s' "$elapsed"
        for pid in "$replay" "$node" "$record"; do memory "$pid"; done
        echo
    done
    # In the order of the data flow, with time for messages in transit.
    for pid in "$replay" "$node" "$record"; do
        kill -INT "$pid"
        wait "$pid"
        sleep 5
    done
    pids=()
    tail -n 1 "$folder/replay.txt" "$folder/node.txt" "$folder/record.txt"
    "$eddy" bag info "$folder/$transport" | grep -E "particles|prediction"
    rm -rf "${folder:?}/$transport"
done
