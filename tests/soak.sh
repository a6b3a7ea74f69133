#!/usr/bin/env bash
# The slow tests of the daemon, outside of .ci/run: full rate for ten minutes from a recording of six and of three patterns
# and from the simulator, 200 kills, a day of work in virtual time. Prints what each took and ends with the number that failed.
#
#   tests/soak.sh               # about 50 minutes
#   SECONDS_EACH=60 tests/soak.sh
set -uo pipefail
cd "$(dirname "$0")/.."
seconds=${SECONDS_EACH:-600}
cargo build --release --locked -p gv3 || exit 1
GV3=${CARGO_TARGET_DIR:-target}/release/gv3

failed=0
step() {
    local name=$1 begin=$SECONDS
    shift
    echo "== $name: $*"
    "$@" || { echo "== FAILED: $name"; failed=$((failed + 1)); }
    echo "== $name took $((SECONDS - begin)) s"
}

step "six patterns" "$GV3" bench live --seconds "$seconds" --check
step "three patterns" "$GV3" bench live --patterns 3 --seconds "$seconds" --check
step "simulator" "$GV3" bench live --sim --patterns 3 --seconds "$seconds" --check
step "200 kills" cargo test --locked -p gv3 --test live_kill -- --ignored
step "memory limit" cargo test --locked -p gv3 --test memory_limit -- --ignored
step "SIGTERM" cargo test --locked -p gv3 --test served -- --ignored
step "a day" cargo test --locked -p gv3 --lib live::tests::day -- --ignored
step "random faults" env PROPTEST_CASES=2000 PROPTEST_RNG_SEED=$RANDOM cargo test --locked -p gv3-protocol
echo "== $failed failed"
[ "$failed" = 0 ]
