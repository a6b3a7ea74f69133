#!/usr/bin/env bash
# Both USB transports against devices that a Linux kernel sees as real ones, in the virtual-machine lab: control, bulk, interrupt,
# empty packets, stalls, a second program, unplugging and finding again; then the projector's driver over each.
# Exit code 0 when all is well or there is no lab, 1 otherwise.
. "$(dirname "$0")/common.sh"
share_gv3
share_example gv3 usb_transports

echo "== pipes"
machine --udev --timeout 300 --share "$work/share/usb_transports" -c '
bad=0
plug() { usbsim vendor 2>/dev/null & sim=$!; for i in $(seq 300); do lsusb -d 1209:0001 >/dev/null && break; sleep .1; done; }
for transport in nusb rusb; do
    plug
    usb_transports $transport pipes replug >/tmp/log 2>&1 & test=$!
    for i in $(seq 600); do grep -q -E "UNPLUG|rror" /tmp/log && break; sleep .1; done
    usb_transports $transport pipes >/tmp/second 2>&1 && bad=1
    grep "in use by another program" /tmp/second || { cat /tmp/second; bad=1; }
    kill $sim; wait $sim 2>/dev/null; sleep 1; plug
    wait $test || bad=1
    cat /tmp/log
    kill $sim; wait $sim 2>/dev/null; sleep 1
done
exit $bad' | sed 's/^/   /'

# The projector is served at the host's own speed; ending the server pulls it out, QEMU looks for it every second.
echo "== projector"
mkdir "$work/live"
plug_in_projector() {
    plug_in "$work/live/projector.sock" "$work/share/gv3" virtual-scanner --devices projector --redir "$work/live"
}
before_machine() {
    pull_out
    rm -f "$work"/live/*.log
    plug_in_projector
}
machine --udev --timeout 300 --mount "$work/live:/live" --redir "$work/live/projector.sock" --share "$work/share/usb_transports" -c '
bad=0
for transport in nusb rusb; do
    for i in $(seq 300); do lsusb -d 1209:0001 >/dev/null && break; sleep .1; done
    usb_transports $transport projector replug >/live/$transport.log 2>&1 || bad=1
    cat /live/$transport.log
done
exit $bad' >"$work/said" 2>&1 &
run=$!
for transport in nusb rusb; do
    wait_for "the end of the cable to be pulled" grep -q -E "UNPLUG|rror" "$work/live/$transport.log" || break
    pull_out
    sleep 2
    plug_in_projector
    sleep 3
done
status=0
wait $run || status=$?
sed 's/^/   /' "$work/said"
[ $status = 0 ] || fail "the projector's driver"
echo "usb_transports: all well"
