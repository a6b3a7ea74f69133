# What the scripts of the virtual-machine lab share; to be sourced at their beginning. It goes to the repository's root, ends the
# script with 0 and a reason where there is no lab, and at its end ends what it started, and nothing else.
#
# GV3_LAB is where the lab is (../shared/lab), LAB_CACHE where it was built, GV3 the program to try, where it is built already.
# shellcheck shell=bash disable=SC2034
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/../.."
lab=${GV3_LAB:-../shared/lab}
cache=${LAB_CACHE:-${XDG_CACHE_HOME:-$HOME/.cache}/gv3-lab}
binaries=${CARGO_TARGET_DIR:-target}/debug
if [ ! -x "$lab/lab-run" ] || [ ! -e "$cache/base.cpio" ]; then
    echo "skipped: no lab at $lab (GV3_LAB), or lab-build was not run"
    exit 0
fi

work=$(mktemp -d)
trap 'pull_out; rm -rf "$work"' EXIT
mkdir "$work/share"

# Builds an example of a crate and puts it into the folder that the machine gets: crate, name.
share_example() {
    cargo build --quiet --locked -p "$1" --example "$2"
    strip -o "$work/share/$2" "$binaries/examples/$2"
}

# Builds gv3, unless GV3 names one that is built, and puts it there.
share_gv3() {
    if [ -z "${GV3:-}" ]; then
        cargo build --quiet --locked -p gv3
        GV3=$binaries/gv3
    fi
    strip -o "$work/share/gv3" "$GV3"
}

# Starts a server of USB devices for machines and waits until it listens: its sockets in one word, then the command. Its number
# is kept in a file, as machines run in shells of their own.
plug_in() {
    local sockets=$1 socket
    shift
    # shellcheck disable=SC2086
    rm -f $sockets
    "$@" >"$work/server.log" 2>&1 &
    echo $! >"$work/server"
    for socket in $sockets; do
        wait_for "$socket" test -S "$socket" || fail "no device is served: $(cat "$work/server.log")"
    done
}

# Ends it, which pulls the devices' cables.
pull_out() {
    local server
    [ -e "$work/server" ] || return 0
    server=$(cat "$work/server")
    rm "$work/server"
    kill "$server" 2>/dev/null || true
    wait "$server" 2>/dev/null || true
}

# Rig files of the virtual scanner at a time from picture to picture, milliseconds, into the folder that the machine gets: the
# built-in rig (simulated), camera and projector (nusb, rusb), with a trigger controller, with a LightCrafter 4500.
rig_files() {
    local to=$work/share
    sed "s/^picture_period_nanos = .*/picture_period_nanos = ${1}000000/" config/simulated.toml >"$to/simulated.toml"
    devices_rig() { # lines in the place of the projector's backend
        sed -e '/^\[camera\]/,/^\[projector\]/s/^backend = .*/backend = "v4l"/' \
            -e "/^\\[projector\\]/,/^\\[timing\\]/s/^backend = .*/$1/" "$to/simulated.toml"
        printf '\n[camera.v4l]\nname = "gv3 virtual camera"\n'
    }
    devices_rig 'backend = "gv3_usb"\ntransport = "nusb"' >"$to/nusb.toml"
    devices_rig 'backend = "gv3_usb"\ntransport = "rusb"' >"$to/rusb.toml"
    { cat "$to/nusb.toml"; printf '\n[trigger]\nbackend = "serial"\nport = "/dev/ttyACM0"\n'; } >"$to/trigger.toml"
    { devices_rig 'backend = "dlpc350"'
      printf '\n[projector.dlpc350]\nlink = "hidraw"\nsource = "flash"\nbit_depth = 7\nflash_images = [0, 1]\n'
      printf 'light = "white"\nled_current = [60, 60, 60]\nled_limit_a = 4.3\n'; } >"$to/light-crafter.toml"
}

# What a shell in the machine runs to wait for the virtual scanner's devices of a rig.
wait_in_machine() {
    local nodes=/dev/video1
    case $1 in
    trigger) nodes+=" /dev/ttyACM0" ;;
    light-crafter) nodes+=" /dev/hidraw0" ;;
    esac
    echo "wait-for -t 60 $nodes; for i in \$(seq 300); do lsusb -d 1209:0001 || lsusb -d 0451:6401 && break; sleep .1; done >/dev/null"
}

# Waits up to two minutes until a command says yes: what is waited for, command.
wait_for() {
    local what=$1 i
    shift
    for i in $(seq 1200); do
        "$@" 2>/dev/null && return
        sleep 0.1
    done
    echo "waited in vain for $what"
    return 1
}

# Scripts whose devices are the host's redefine it: what has to be begun anew with a machine.
before_machine() { :; }

# lab-run with options, `-c` and a script. Once more, and again, when the machine itself did not come up, which is status 125 and
# happens on a busy host; never for what ran in it. There its kernel also measures its processor's clock wrongly, up to twenty
# times too fast: the machine's time is taken from its ACPI timer, which goes with the host's.
machine() {
    local status options=("${@:1:$#-1}") clocks=/sys/devices/system/clocksource/clocksource0
    for _ in 1 2 3; do
        before_machine
        status=0
        "$lab/lab-run" "${options[@]}" "echo acpi_pm >$clocks/current_clocksource
${!#}" || status=$?
        [ "$status" = 125 ] || return $status
        echo "the virtual machine did not come up" >&2
    done
    return $status
}

fail() {
    echo "FAILED: $*"
    exit 1
}
