#!/usr/bin/env bash
# The device contract (tests/tests/device_contract.rs, feature real-rig) in the virtual-machine lab: V4L2 camera and vendor-protocol
# projector, by nusb and by rusb, and the LightCrafter behind hidraw, all of them `gv3 virtual-scanner` on the host.
# Exit code 0 when all is well or there is no lab, 1 otherwise.
#
# RIGS names the rigs. A busy host may make a picture late, which the contract takes for a fault: what fails is tried again with
# more time from picture to picture (PERIODS_MS). A contract that is broken is broken at every pace.
. "$(dirname "$0")/common.sh"
share_gv3
contract=$(cargo test --locked -p gv3-tests --features real-rig --test device_contract --no-run --message-format json 2>/dev/null |
    sed -n 's/.*"executable":"\([^"]*device_contract[^"]*\)".*/\1/p' | tail -n 1)
strip -o "$work/share/contract" "$contract"
sockets="$work/usb/camera.sock $work/usb/projector.sock"

for rig in ${RIGS:-nusb rusb light-crafter}; do
    before_machine() {
        pull_out
        plug_in "$sockets" "$GV3" virtual-scanner --config "$work/share/$rig.toml" --redir "$work/usb"
    }
    for period_ms in ${PERIODS_MS:-250 500 1000}; do
        echo "== $rig, a picture every $period_ms ms"
        begin=$SECONDS
        rig_files "$period_ms"
        status=0
        machine --timeout 250 --udev --share "$work/share" --redir "$work/usb/camera.sock" \
            --redir "$work/usb/projector.sock" -c "
            cd /share/share; $(wait_in_machine "$rig")
            GV3_RIG=$rig.toml ./contract the_real_rig --nocapture" >"$work/said" 2>&1 || status=$?
        [ $status = 0 ] && break
        sed 's/^/   /' "$work/said"
    done
    [ $status = 0 ] || fail "$rig"
    grep "test result" "$work/said" | sed 's/^/   /'
    echo "   $rig took $((SECONDS - begin)) s"
done
echo "contract: all well"
