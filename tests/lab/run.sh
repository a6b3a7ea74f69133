#!/usr/bin/env bash
# All proofs against a real kernel, in the virtual-machine lab (GV3_LAB, default ../shared/lab), with the time that each took.
# Where the lab is not there, cannot be built or does not boot, it says so and succeeds.
#
#   tests/lab/run.sh             everything
#   tests/lab/run.sh --short     what a change may break first, some minutes: the rules, trigger, USB, short captures
set -uo pipefail
cd "$(dirname "$0")/../.." || exit 1
lab=${GV3_LAB:-../shared/lab}
cache=${LAB_CACHE:-${XDG_CACHE_HOME:-$HOME/.cache}/gv3-lab}

skip() {
    echo "lab: skipped: $*"
    exit 0
}
[ -x "$lab/lab-run" ] || skip "there is none at $lab (GV3_LAB)"
command -v qemu-system-x86_64 >/dev/null || [ -x "$lab/lab-build" ] || skip "no qemu-system-x86_64"
if [ ! -e "$cache/base.cpio" ]; then
    "$lab/lab-build" >"${TMPDIR:-/tmp}/lab-build.log" 2>&1 || skip "it cannot be built here: ${TMPDIR:-/tmp}/lab-build.log"
fi
boots() {
    for _ in 1 2 3; do "$lab/lab-run" --timeout 120 -- true >/dev/null 2>&1 && return; done
    return 1
}
boots || skip "its virtual machine does not boot here"

scripts="udev trigger camera usb_transports contract capture"
if [ "${1:-}" = --short ]; then
    scripts="udev trigger usb_transports capture"
    export SETS=${SETS:-6} RUNS=${RUNS:-"clean faults camera-replug"}
fi
cargo build --quiet --locked -p gv3 || exit 1
export GV3=${CARGO_TARGET_DIR:-target}/debug/gv3

failed=
for script in $scripts; do
    begin=$SECONDS
    verdict=passed
    "tests/lab/$script.sh" || { verdict=FAILED; failed+=" $script"; }
    echo "== lab: $script $verdict in $((SECONDS - begin)) s"
done
[ -z "$failed" ] || { echo "lab: FAILED:$failed"; exit 1; }
echo "lab: all well"
