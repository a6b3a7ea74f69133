#!/usr/bin/env bash
# The device contract (tests/tests/device_contract.rs, feature real-rig) in the virtual-machine lab: V4L2 camera and vendor-protocol
# projector, by nusb and by rusb, and the LightCrafter behind hidraw, all of them `gv3 virtual-scanner` on the host.
# Exit code 0 when all is well or there is no lab, 1 otherwise. PERIOD_MS (default 250) is the time from picture to picture.
set -euo pipefail
cd "$(dirname "$0")/../.."
lab=${GV3_LAB:-../shared/lab}
cache=${LAB_CACHE:-${XDG_CACHE_HOME:-$HOME/.cache}/gv3-lab}
if [ ! -x "$lab/lab-run" ] || [ ! -e "$cache/base.cpio" ]; then
    echo "skipped: no lab at $lab (GV3_LAB), or lab-build was not run"
    exit 0
fi
period_ms=${PERIOD_MS:-250}
if [ -z "${GV3:-}" ]; then
    cargo build --quiet --locked -p gv3
    GV3=${CARGO_TARGET_DIR:-target}/debug/gv3
fi
contract=$(cargo test --locked -p gv3-tests --features real-rig --test device_contract --no-run --message-format json 2>/dev/null |
    sed -n 's/.*"executable":"\([^"]*device_contract[^"]*\)".*/\1/p' | tail -n 1)

work=$(mktemp -d)
scanner=
# Only what was started here is ended.
trap 'kill $scanner 2>/dev/null || true; rm -rf "$work"' EXIT
mkdir "$work/share"
strip -o "$work/share/contract" "$contract"
as_devices() { # projector's backend
    sed -e "s/^picture_period_nanos = .*/picture_period_nanos = ${period_ms}000000/" \
        -e '/^\[camera\]/,/^\[projector\]/s/^backend = .*/backend = "v4l"/' \
        -e "/^\\[projector\\]/,/^\\[timing\\]/s/^backend = .*/backend = \"$1\"\\n${2:-}/" config/simulated.toml
    printf '\n[camera.v4l]\nname = "gv3 virtual camera"\n'
}
as_devices gv3_usb 'transport = "nusb"' >"$work/share/nusb.toml"
as_devices gv3_usb 'transport = "rusb"' >"$work/share/rusb.toml"
{ as_devices dlpc350
  printf '\n[projector.dlpc350]\nlink = "hidraw"\nsource = "flash"\nbit_depth = 7\nflash_images = [0, 1]\n'
  printf 'light = "white"\nled_current = [60, 60, 60]\nled_limit_a = 4.3\n'; } >"$work/share/light-crafter.toml"

for rig in ${RIGS:-nusb rusb light-crafter}; do
    echo "== $rig"
    status=0
    for _ in 1 2 3; do
        rm -rf "$work/usb"
        "$GV3" virtual-scanner --config "$work/share/$rig.toml" --redir "$work/usb" >"$work/scanner" 2>&1 &
        scanner=$!
        for _ in $(seq 100); do [ -S "$work/usb/projector.sock" ] && break; sleep 0.1; done
        status=0
        "$lab/lab-run" --timeout 200 --udev --share "$work/share" --redir "$work/usb/camera.sock" --redir "$work/usb/projector.sock" -c "
            wait-for /dev/video1; for i in \$(seq 50); do lsusb -d 1209:0001 || lsusb -d 0451:6401 && break; sleep .1; done; sleep 1
            cd /share/share; GV3_RIG=$rig.toml ./contract the_real_rig --nocapture" >"$work/said" 2>&1 || status=$?
        kill $scanner 2>/dev/null || true
        wait $scanner 2>/dev/null || true
        # A busy computer may not even start a virtual machine, or make a picture late; a broken contract breaks it thrice.
        [ $status = 0 ] && break
        sed 's/^/   /' "$work/said"
    done
    [ $status = 0 ] || { echo "FAILED: $rig"; exit 1; }
    grep "test result" "$work/said" | sed 's/^/   /'
done
echo "contract: all well"
