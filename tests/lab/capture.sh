#!/usr/bin/env bash
# A whole capture through a real kernel, in the virtual-machine lab: `gv3 capture` in the guest with V4L2 camera, vendor-protocol
# projector and serial trigger, which are `gv3 virtual-scanner` on the host; then the same with faults. Every picture must be
# the one that the simulator in process takes at its place, in sets that are whole, or not be there at all.
# Exit code 0 when all is well or there is no lab, 1 otherwise. SETS (default 60) is the length of the clean run, PERIOD_MS
# (default 250) the time from picture to picture. The emulated machine's clock is not the host's, and runs off when the computer
# is busy; a picture a quarter of a period off drops its set. So one set in ten may be missing, but none may be wrong.
set -euo pipefail
cd "$(dirname "$0")/../.."
lab=${GV3_LAB:-../shared/lab}
cache=${LAB_CACHE:-${XDG_CACHE_HOME:-$HOME/.cache}/gv3-lab}
if [ ! -x "$lab/lab-run" ] || [ ! -e "$cache/base.cpio" ]; then
    echo "skipped: no lab at $lab (GV3_LAB), or lab-build was not run"
    exit 0
fi
sets=${SETS:-60}
period_ms=${PERIOD_MS:-250}
seconds() { # of so many sets
    awk "BEGIN{print $1 * 6 * $period_ms / 1000}"
}
if [ -z "${GV3:-}" ]; then
    cargo build --quiet --locked -p gv3
    GV3=${CARGO_TARGET_DIR:-target}/debug/gv3
fi

work=$(mktemp -d)
scanner=
# Only what was started here is ended.
trap 'kill $scanner 2>/dev/null || true; rm -rf "$work"' EXIT
mkdir "$work/share"
strip -o "$work/share/gv3" "$GV3"

# The built-in rig at a rate that the emulated machine keeps up with; simulated, and as devices.
sed "s/^picture_period_nanos = .*/picture_period_nanos = ${period_ms}000000/" config/simulated.toml >"$work/share/simulated.toml"
as_devices() { # with or without a trigger controller
    sed -e '/^\[camera\]/,/^\[projector\]/s/^backend = .*/backend = "v4l"/' \
        -e '/^\[projector\]/,/^\[timing\]/s/^backend = .*/backend = "gv3_usb"/' "$work/share/simulated.toml"
    printf '\n[camera.v4l]\nname = "gv3 virtual camera"\n'
    [ "$1" = without ] || printf '\n[trigger]\nbackend = "serial"\nport = "/dev/ttyACM0"\n'
}
as_devices with >"$work/share/trigger.toml"
as_devices without >"$work/share/projector.toml"

"$GV3" capture --raw "$work/expected-raw" --config "$work/share/simulated.toml" --seconds "$(seconds $((sets + 10)))" >/dev/null
"$GV3" export-raw "$work/expected-raw" -o "$work/expected" >/dev/null

fail() {
    echo "FAILED: $*"
    exit 1
}

# Name, rig, sets, then options of the virtual scanner; sets `status`.
run() {
    name=$1 rig=$2 count=$3
    shift 3
    devices=camera,projector
    sockets=("$work/$name-usb/camera.sock" "$work/$name-usb/projector.sock")
    wait_for="/dev/video1"
    if [ "$rig" = trigger ]; then
        devices+=,trigger
        sockets+=("$work/$name-usb/trigger.sock")
        wait_for+=" /dev/ttyACM0"
    fi
    echo "== $name"
    "$GV3" virtual-scanner --config "$work/share/simulated.toml" --devices "$devices" --redir "$work/$name-usb" "$@" \
        >"$work/$name.scanner" 2>&1 &
    scanner=$!
    for _ in $(seq 100); do [ -S "${sockets[-1]}" ] && break; sleep 0.1; done
    redirections=()
    for socket in "${sockets[@]}"; do redirections+=(--redir "$socket"); done
    # On a busy computer an emulated machine may not even start (125).
    for _ in 1 2 3; do
        status=0
        "$lab/lab-run" --timeout 280 --udev --share "$work/share" --out "$work/$name" "${redirections[@]}" -c "
            wait-for $wait_for; cd /share/share
            ./gv3 capture --raw /out/raw --config $rig.toml --seconds $(seconds "$count") --json >/out/report 2>/out/messages" \
            2>"$work/$name.machine" || status=$?
        [ $status = 125 ] || break
    done
    [ -e "$work/$name/messages" ] || { cat "$work/$name.machine"; fail "$name: no machine"; }
    kill $scanner 2>/dev/null || true
    wait $scanner 2>/dev/null || true
    sed 's/^/   /' "$work/$name/messages"
}

# Every set of a run equals the simulator's of the same tick; at least `least` of them.
compare() {
    name=$1 least=$2
    "$GV3" export-raw "$work/$name/raw" -o "$work/$name/pictures" >/dev/null
    same=0
    for folder in "$work/$name/pictures"/set_*; do
        [ "$(ls "$folder"/*.png | wc -l)" = 6 ] || continue
        for picture in "$folder"/*.png; do
            cmp "$picture" "$work/expected/$(basename "$folder")/$(basename "$picture")" || fail "$name: another picture"
        done
        same=$((same + 1))
    done
    echo "   $same sets of six pictures equal the simulator's"
    [ "$same" -ge "$least" ] || fail "$name: fewer than $least sets"
}

run clean trigger "$sets"
[ $status = 0 ] || fail "clean: status $status"
compare clean $((sets * 9 / 10))

# Pictures lost, doubled, cut short and late in sets 1 to 4: those sets are missing, the others are right.
run faults trigger 10 --fault lost@8 --fault doubled@16 --fault short@22 --fault late@28
[ $status = 0 ] || fail "faults: status $status"
compare faults 5

# Without a controller: the projector's own trigger line.
run own-line projector 5
[ $status = 0 ] || fail "own-line: status $status"
compare own-line 4

# A camera of another size is refused before anything is recorded.
run size trigger 2 --camera-size 320x240
[ $status = 1 ] && grep -q "320" "$work/size/messages" || fail "size: $status, $(cat "$work/size/messages")"

# A camera that is unplugged ends the run, and what came before is whole.
run unplugged trigger 6 --fault unplug-camera@20
[ $status = 1 ] && grep -q "disconnected" "$work/unplugged/messages" || fail "unplugged: status $status"
compare unplugged 3

echo "capture: all well"
