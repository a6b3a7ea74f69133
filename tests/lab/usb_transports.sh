#!/bin/bash
# Both USB transports against devices that a Linux kernel sees as real ones, in the laboratory's virtual machine: control,
# bulk, interrupt, empty packets, stalls, unplugging and finding again.
#
#   GV3_LAB=/path/to/lab tests/lab/usb_transports.sh [PROFILE]
#
# The laboratory must be built (lab-build). Exit status 0 when everything passed, 77 when there is no laboratory.
set -u
lab=${GV3_LAB:-$(dirname "$0")/../../../shared/lab}
[ -x "$lab/lab-run" ] || { echo "no laboratory at $lab; set GV3_LAB"; exit 77; }
cd "$(dirname "$0")/../.." || exit 1
profile=${1:-dev}
cargo build --quiet --profile "$profile" -p gv3 --example usb_transports || exit 1
folder=${CARGO_TARGET_DIR:-target}/$([ "$profile" = dev ] && echo debug || echo "$profile")
"$lab/lab-run" --udev --timeout 300 --share "$folder/examples/usb_transports" -c '
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
status=$?
[ $status = 0 ] && echo "usb_transports: passed" || echo "usb_transports: FAILED ($status)"
exit $status
