#!/bin/bash
# Both USB transports against devices that a Linux kernel sees as real ones, in the laboratory's virtual machine: control,
# bulk, interrupt, empty packets, stalls, unplugging and finding again; then the projector's driver over each.
#
#   GV3_LAB=/path/to/lab tests/lab/usb_transports.sh [PROFILE]
#
# The laboratory must be built (lab-build). Exit status 0 when everything passed, 77 when there is no laboratory.
set -u
lab=$(realpath "${GV3_LAB:-$(dirname "$0")/../../../shared/lab}")
[ -x "$lab/lab-run" ] || { echo "no laboratory at $lab; set GV3_LAB"; exit 77; }
cd "$(dirname "$0")/../.." || exit 1
profile=${1:-dev}
cargo build --quiet --profile "$profile" -p gv3 --bin gv3 --example usb_transports || exit 1
folder=${CARGO_TARGET_DIR:-target}/$([ "$profile" = dev ] && echo debug || echo "$profile")
probe=$folder/examples/usb_transports

"$lab/lab-run" --udev --timeout 300 --share "$probe" -c '
bad=0
plug() { usbsim vendor 2>/dev/null & sim=$!; for i in $(seq 100); do lsusb -d 1209:0001 >/dev/null && break; sleep .1; done; }
for transport in nusb rusb; do
    plug
    usb_transports $transport pipes replug >/tmp/log 2>&1 & test=$!
    for i in $(seq 300); do grep -q -E "UNPLUG|rror" /tmp/log && break; sleep .1; done
    kill $sim; wait $sim 2>/dev/null; sleep 1; plug
    wait $test || bad=1
    cat /tmp/log
    kill $sim; wait $sim 2>/dev/null; sleep 1
done
exit $bad'
pipes=$?

# The projector is served at the host's own speed; ending the server pulls it out, QEMU looks for it every second.
live=$(mktemp -d)
server=
trap 'kill $server 2>/dev/null; rm -rf "$live"' EXIT
serve() {
    rm -f "$live"/*.sock
    "$folder/gv3" virtual-scanner --devices projector --redir "$live" >"$live/server.log" 2>&1 &
    server=$!
}
serve
for i in $(seq 100); do [ -S "$live/projector.sock" ] && break; sleep .1; done
"$lab/lab-run" --udev --timeout 300 --mount "$live:/live" --redir "$live/projector.sock" --share "$probe" -c '
bad=0
for transport in nusb rusb; do
    for i in $(seq 100); do lsusb -d 1209:0001 >/dev/null && break; sleep .1; done
    usb_transports $transport projector replug >/live/$transport.log 2>&1 || bad=1
    cat /live/$transport.log
done
exit $bad' &
machine=$!
for transport in nusb rusb; do
    for i in $(seq 600); do grep -q -E "UNPLUG|rror" "$live/$transport.log" 2>/dev/null && break; sleep .1; done
    kill $server; wait $server 2>/dev/null; sleep 2; serve; sleep 3
done
wait $machine
driver=$?
[ $pipes = 0 ] && [ $driver = 0 ] && { echo "usb_transports: passed"; exit 0; }
echo "usb_transports: FAILED (pipes $pipes, driver $driver)"
exit 1
