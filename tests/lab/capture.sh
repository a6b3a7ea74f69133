#!/usr/bin/env bash
# Whole captures through a real kernel, in the virtual-machine lab: `gv3 capture` in the guest with V4L2 camera, projector and
# serial trigger, which are `gv3 virtual-scanner` on the host; clean, and with every fault that cables and devices have. Every
# set must be, picture by picture, one that the simulator in process takes, or not be there at all.
#
# Exit code 0 when all is well or there is no lab, 1 otherwise. SETS (default 60: two seconds of a scanner with 30 scans/s) is
# the length of the clean run, PERIOD_MS (default 250) the time from picture to picture. The emulated machine stamps pictures
# when they arrive; when the computer is so busy that one comes a quarter of a period late its set is dropped. A run with too few
# sets is tried again, twice; a set that is wrong ends everything, unless
# the computer was so busy that even the virtual rig's own clock stood still. RUNS names the runs to make, all by default.
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
runs=${RUNS:-clean faults own-line size camera-replug projector-replug light-crafter wrong-mode}
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
as_devices() { # projector's backend
    sed -e '/^\[camera\]/,/^\[projector\]/s/^backend = .*/backend = "v4l"/' \
        -e "/^\\[projector\\]/,/^\\[timing\\]/s/^backend = .*/backend = \"$1\"/" "$work/share/simulated.toml"
    printf '\n[camera.v4l]\nname = "gv3 virtual camera"\n'
}
as_devices gv3_usb >"$work/share/projector.toml"
{ as_devices gv3_usb; printf '\n[trigger]\nbackend = "serial"\nport = "/dev/ttyACM0"\n'; } >"$work/share/trigger.toml"
{ as_devices dlpc350
  printf '\n[projector.dlpc350]\nlink = "hidraw"\nsource = "flash"\nbit_depth = 7\nflash_images = [0, 1]\n'
  printf 'light = "white"\nled_current = [60, 60, 60]\nled_limit_a = 4.3\n'; } >"$work/share/light-crafter.toml"

fail() {
    echo "FAILED: $*"
    exit 1
}

# A line for every whole set of a folder of pictures: its name and the hash of its six pictures in the patterns' order.
hashes() {
    for folder in "$1"/set_*; do
        [ "$(ls "$folder"/*.png | wc -l)" = 6 ] || continue
        echo "$(basename "$folder") $(cat "$folder"/*.png | sha256sum | cut -d' ' -f1)"
    done
}

# A line for every scan of the session that a raw recording gives: hash of the decoded integers.
session_hash() {
    "$GV3" capture "$1.gv3" --from-raw "$1" >/dev/null 2>&1
    "$GV3" decode "$1.gv3" -o "$1-scans" --as mesh --format ply >/dev/null
    (cd "$1-scans" && find . -type f | sort | xargs sha256sum) | sha256sum | cut -d' ' -f1
}

expect() { # name, sets
    "$GV3" capture --raw "$work/$1-raw" --config "$work/share/simulated.toml" --seconds "$(seconds "$2")" >/dev/null
    "$GV3" export-raw "$work/$1-raw" -o "$work/$1" >/dev/null
    hashes "$work/$1" >"$work/$1.hashes"
}
expect expected "$sets"
# Whatever a run of any length here may show; a run that is begun anew shows the first sets again.
expect any $((sets > 20 ? sets : 20))

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
    [ "$rig" != light-crafter ] || wait_for+=" /dev/hidraw0"
    echo "== $name"
    redirections=()
    for socket in "${sockets[@]}"; do redirections+=(--redir "$socket"); done
    # On a busy computer an emulated machine may not even start (125).
    for _ in 1 2 3; do
        rm -rf "$work/$name" "$work/$name-usb"
        "$GV3" virtual-scanner --config "$work/share/$rig.toml" --devices "$devices" --redir "$work/$name-usb" "$@" \
            >"$work/$name.scanner" 2>&1 &
        scanner=$!
        for _ in $(seq 100); do [ -S "${sockets[-1]}" ] && break; sleep 0.1; done
        status=0
        "$lab/lab-run" --timeout 280 --udev --share "$work/share" --out "$work/$name" "${redirections[@]}" -c "
            wait-for $wait_for; cd /share/share
            ./gv3 capture --raw /out/raw --config $rig.toml --seconds $(seconds "$count") --json >/out/report 2>/out/messages" \
            2>"$work/$name.machine" || status=$?
        kill $scanner 2>/dev/null || true
        wait $scanner 2>/dev/null || true
        [ $status = 125 ] || break
    done
    [ -e "$work/$name/messages" ] || { cat "$work/$name.machine"; fail "$name: no machine"; }
    sed 's/^/   /' "$work/$name/messages"
}

# That the virtual rig's time stood still for more than half a period, because the emulated machine did not fetch its pictures.
stood() {
    stood_ms=$(sed -n 's/.*stood_ms=\([0-9]*\).*/\1/p' "$work/$name.scanner" | tail -n 1)
    [ $((2 * ${stood_ms:-0})) -gt "$period_ms" ]
}

# Every whole set of a run is, all six pictures of it, one set of the simulator's. 1 when there are fewer than `least` of them.
compare() {
    name=$1 least=$2
    "$GV3" export-raw "$work/$name/raw" -o "$work/$name/pictures" >/dev/null
    hashes "$work/$name/pictures" >"$work/$name.hashes"
    while read -r set hash; do
        grep -q " $hash\$" "$work/any.hashes" && continue
        # No scanner's clock stops for want of a reader; gv3 cannot tell a rig that does from one that misses pictures.
        if stood; then echo "   void: the virtual rig's time stood still for $stood_ms ms"; return 1; fi
        fail "$name: $set is no set of the simulator's"
    done <"$work/$name.hashes"
    same=$(wc -l <"$work/$name.hashes")
    echo "   $same whole sets, each one of the simulator's"
    [ "$same" -ge "$least" ]
}

# 1 when the report counts fewer sets dropped for a cause.
dropped() { # cause least
    local count
    count=$(sed -n "s/^ *\"$1\": \([0-9]*\),\{0,1\}$/\1/p" "$work/$name/report" | head -n 1)
    echo "   $1: ${count:-not counted}"
    [ "${count:-0}" -ge "$2" ]
}

# That a run ended well. 1 when the machine was too slow to end at all.
ended() { # status
    [ "$status" != 124 ] || return 1
    [ "$status" = "$1" ] || fail "$name: status $status"
}

clean() {
    run clean trigger "$sets"
    ended 0 && compare clean "$sets" || return 1
    cmp "$work/clean.hashes" "$work/expected.hashes" || fail "clean: other sets, or in another order, than the simulator's"
    [ "$(session_hash "$work/clean/raw")" = "$(session_hash "$work/expected-raw")" ] || fail "clean: another session"
    echo "   order and decoded integers have the hash of the simulator's session"
}

# Pictures lost, doubled, cut short, late and stalled: their sets are missing, or the run is begun anew where the order cannot be
# known any more; all others are right.
faults() {
    run faults trigger 16 --fault lost@8 --fault doubled@26 --fault short@40 --fault late@54 --fault stalled@68
    ended 0 && compare faults 5 && dropped lost 2
    local enough=$?
    dropped doubled 0 && dropped late 0
    return $enough
}

# Without a controller: the projector's own trigger line.
own-line() {
    run own-line projector 5
    ended 0 && compare own-line 3
}

# A camera of another size is refused before anything is recorded.
size() {
    run size trigger 2 --camera-size 320x240
    ended 1 && { grep -q 320 "$work/size/messages" || fail "size: not refused for its size"; }
}

# A cable that is pulled, and put back after a second or two: the run goes on by itself, and no set has pictures of both sides.
replug() { # device
    run "$1-replug" projector 10 --fault "unplug-$1@15"
    ended 0 || return 1
    grep -q "the capture is interrupted" "$work/$1-replug/messages" || fail "$1-replug: nobody noticed"
    compare "$1-replug" 4 && dropped lost 1
}
camera-replug() { replug camera; }
projector-replug() { replug projector; }

# As a LightCrafter 4500 behind hidraw.
light-crafter() {
    run light-crafter light-crafter 4
    ended 0 && compare light-crafter 3
}

# It falls back to video mode in the middle of a set, and is set going again.
wrong-mode() {
    run wrong-mode light-crafter 10 --fault wrong-mode@15
    ended 0 || return 1
    grep -q "the capture is interrupted" "$work/wrong-mode/messages" || fail "wrong-mode: nobody noticed"
    compare wrong-mode 4 && dropped lost 1
}

for one in $runs; do
    for attempt in 1 2 3 none; do
        [ $attempt != none ] || fail "$one: three times too few sets"
        begin=$SECONDS
        if $one; then break; fi
        echo "   the computer is too busy for this; once more"
    done
    echo "   $one took $((SECONDS - begin)) s"
done
echo "capture: all well"
