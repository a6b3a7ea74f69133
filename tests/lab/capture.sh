#!/usr/bin/env bash
# Whole captures through a real kernel, in the virtual-machine lab: `gv3 capture` in the guest with V4L2 camera, projector and
# serial trigger, which are `gv3 virtual-scanner` on the host; clean, and with every fault that cables and devices have. Every
# set must be, picture by picture, one that the simulator in process takes, or not be there at all.
#
# Exit code 0 when all is well or there is no lab, 1 otherwise. RUNS names the runs to make, all by default; SETS (default 60: two
# seconds of a scanner with 30 scans/s) is the length of the clean one. The emulated machine stamps pictures when they arrive:
# on a busy host they come late, and their sets are dropped, as they must be. A run with too few sets is made again with more
# time from picture to picture (PERIODS_MS). A set that is wrong ends everything, at any pace.
. "$(dirname "$0")/common.sh"
sets=${SETS:-60}
runs=${RUNS:-clean faults own-line size camera-replug projector-replug light-crafter wrong-mode}
share_gv3

seconds() { # of so many sets
    awk "BEGIN{print $1 * 6 * $period_ms / 1000}"
}

# A line for every whole set of a folder of pictures: its name and the hash of its six pictures in the patterns' order.
hashes() {
    local folder
    for folder in "$1"/set_*; do
        [ "$(ls "$folder"/*.png | wc -l)" = 6 ] || continue
        echo "$(basename "$folder") $(cat "$folder"/*.png | sha256sum | cut -d' ' -f1)"
    done
}

# Hash of the decoded integers of all scans of the session that a raw recording gives.
session_hash() {
    "$GV3" capture "$1.gv3" --from-raw "$1" >/dev/null 2>&1
    "$GV3" decode "$1.gv3" -o "$1-scans" --as mesh --format ply >/dev/null
    (cd "$1-scans" && find . -type f | sort | xargs sha256sum) | sha256sum | cut -d' ' -f1
}

# What the simulator in process takes at the present pace: the sets of the clean run, and as many as any run here shows; a run
# that is begun anew shows the first sets again.
simulate() {
    simulated=$work/simulated-$period_ms
    rig_files "$period_ms"
    [ ! -d "$simulated" ] || return 0
    mkdir "$simulated"
    "$GV3" capture --raw "$simulated/raw" --config "$work/share/simulated.toml" --seconds "$(seconds "$sets")" >/dev/null
    "$GV3" capture --raw "$simulated/any-raw" --config "$work/share/simulated.toml" \
        --seconds "$(seconds $((sets > 20 ? sets : 20)))" >/dev/null
    for part in "" any-; do
        "$GV3" export-raw "$simulated/${part}raw" -o "$simulated/${part}pictures" >/dev/null
        hashes "$simulated/${part}pictures" >"$simulated/${part}hashes"
        rm -r "$simulated/${part}pictures"
    done
}

# Name, rig, sets, then options of the virtual scanner; sets `status`. `meanwhile` is what the machine does besides.
meanwhile=true
run() {
    name=$1
    local rig=$2 count=$3 devices=camera,projector sockets=() redirections=() socket
    shift 3
    [ "$rig" != trigger ] || devices+=,trigger
    for socket in ${devices//,/ }; do
        sockets+=("$work/usb/$socket.sock")
        redirections+=(--redir "$work/usb/$socket.sock")
    done
    scanner=("$GV3" virtual-scanner --config "$work/share/$rig.toml" --devices "$devices" --redir "$work/usb" "$@")
    before_machine() {
        pull_out
        rm -rf "${work:?}/$name"
        plug_in "${sockets[*]}" "${scanner[@]}"
    }
    status=0
    machine --timeout 600 --udev --share "$work/share" --out "$work/$name" "${redirections[@]}" -c "
        cd /share/share; $(wait_in_machine "$rig")
        ./gv3 capture --raw /out/raw --config $rig.toml --seconds $(seconds "$count") --json >/out/report 2>/out/messages &
        $meanwhile
        wait \$!" \
        2>"$work/$name.machine" || status=$?
    pull_out
    [ -e "$work/$name/messages" ] || { cat "$work/$name.machine"; fail "$name: no machine"; }
    sed 's/^/   /' "$work/$name/messages"
}

# Every whole set of a run is, all six pictures of it, one set of the simulator's. 1 when there are fewer than `least` of them.
compare() {
    name=$1 least=$2
    "$GV3" export-raw "$work/$name/raw" -o "$work/$name/pictures" >/dev/null
    hashes "$work/$name/pictures" >"$work/$name/hashes"
    while read -r set hash; do
        grep -q " $hash\$" "$simulated/any-hashes" || fail "$name: $set is no set of the simulator's"
    done <"$work/$name/hashes"
    same=$(wc -l <"$work/$name/hashes")
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
    cmp "$work/clean/hashes" "$simulated/hashes" || fail "clean: other sets, or in another order, than the simulator's"
    [ "$(session_hash "$work/clean/raw")" = "$(session_hash "$simulated/raw")" ] || fail "clean: another session"
    echo "   order and decoded integers have the hash of the simulator's session"
}

# Pictures lost, doubled, cut short, late and stalled: their sets are missing, or the run is begun anew where the order cannot be
# known any more, and each is counted under its cause; all others are right.
faults() {
    run faults trigger 16 --fault lost@8 --fault doubled@26 --fault short@40 --fault late@54 --fault stalled@68
    ended 0 && compare faults 5 && dropped lost 3 && dropped doubled 1 && dropped late 1
}

# Without a controller: the projector's own trigger line. A second capture with the same devices is refused, and does no harm.
own-line() {
    meanwhile='for i in $(seq 600); do [ "$(du -s /out/raw 2>/dev/null | cut -f1)0" -gt 3000 ] && break; sleep .1; done
        ! ./gv3 capture --raw /out/second --config nusb.toml --seconds 9 2>/out/second-messages || touch /out/second-done' \
        run own-line nusb 8
    ended 0 || return 1
    sed 's/^/   second: /' "$work/own-line/second-messages"
    [ ! -e "$work/own-line/second-done" ] || fail "own-line: two captures with the same devices"
    grep -q "in use by another program" "$work/own-line/second-messages" || fail "own-line: refused for another reason"
    compare own-line 3
}

# A camera of another size is refused before anything is recorded.
size() {
    run size trigger 2 --camera-size 320x240
    ended 1 && { grep -q 320 "$work/size/messages" || fail "size: not refused for its size"; }
}

# A cable that is pulled, and put back after a second or two: the run goes on by itself, and no set has pictures of both sides.
replug() { # device
    run "$1-replug" nusb 10 --fault "unplug-$1@15"
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
    for period_ms in ${PERIODS_MS:-250 500 1000} none; do
        [ "$period_ms" != none ] || fail "$one: too few sets at every pace"
        begin=$SECONDS
        echo "== $one, a picture every $period_ms ms"
        simulate
        if $one; then break; fi
        echo "   the computer is too busy for this pace"
    done
    echo "   $one took $((SECONDS - begin)) s"
done
echo "capture: all well"
