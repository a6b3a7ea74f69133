#!/usr/bin/env bash
# The slow tests of the daemon, outside of .ci/run: full rate for ten minutes from a recording of six and of three patterns and
# from the simulator, 200 kills, a limit on memory, a day of work in virtual time, a crowd of clients in real time, random
# faults. Prints what each took and ends with the number that failed.
#
#   tests/soak.sh               # all of it, about 50 minutes
#   tests/soak.sh kills day     # some parts: six three simulator kills memory day clients faults
#   SECONDS_EACH=60 tests/soak.sh six
set -uo pipefail
cd "$(dirname "$0")/.."
seconds=${SECONDS_EACH:-600}
parts=("$@")
[ $# -gt 0 ] || parts=(six three simulator kills memory day clients faults)

live() {
    cargo build --release --locked -p gv3 || return 1
    "${CARGO_TARGET_DIR:-target}/release/gv3" bench live --seconds "$seconds" --check "$@"
}

slow() {
    cargo test --locked -p gv3 "$@" -- --ignored
}

run() {
    case $1 in
        six) live ;;
        three) live --patterns 3 ;;
        simulator) live --sim --patterns 3 ;;
        kills) slow --test live_kill ;;
        memory) slow --test memory_limit ;;
        day) slow --lib live::tests::day ;;
        clients) slow --lib in_real_time ;;
        faults) PROPTEST_CASES=2000 PROPTEST_RNG_SEED=$RANDOM cargo test --locked -p gv3-protocol ;;
        *) echo "no such part: $1" >&2; return 1 ;;
    esac
}

failed=0
for part in "${parts[@]}"; do
    begin=$SECONDS
    echo "== $part"
    run "$part" || { echo "== FAILED: $part"; failed=$((failed + 1)); }
    echo "== $part took $((SECONDS - begin)) s"
done
echo "== $failed failed"
[ "$failed" = 0 ]
