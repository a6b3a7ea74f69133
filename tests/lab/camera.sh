#!/usr/bin/env bash
# The V4L2 camera against real kernel drivers, in the virtual-machine lab: vivid, v4l2loopback and a simulated USB video class
# device, unplugged and plugged in again while it streams. Exit code 0 when all is well or there is no lab, 1 otherwise.
set -euo pipefail
cd "$(dirname "$0")/../.."
lab=${GV3_LAB:-../shared/lab}
cache=${LAB_CACHE:-${XDG_CACHE_HOME:-$HOME/.cache}/gv3-lab}
if [ ! -x "$lab/lab-run" ] || [ ! -e "$cache/base.cpio" ]; then
    echo "skipped: no lab at $lab (GV3_LAB), or lab-build was not run"
    exit 0
fi
cargo build --quiet --locked -p gv3-tests --example camera_probe
probe=${CARGO_TARGET_DIR:-target}/debug/examples/camera_probe

work=$(mktemp -d)
usbsim=
# Only what was started here is ended.
trap 'kill $usbsim 2>/dev/null || true; rm -rf "$work"' EXIT

plug_in() {
    rm -f "$work/uvc"
    "$cache/target/release/usbsim" uvc --super --redir "$work/uvc" >>"$work/usbsim.log" 2>&1 &
    usbsim=$!
    for _ in $(seq 100); do [ -S "$work/uvc" ] && return; sleep 0.1; done
    echo "the simulated camera does not start"
    exit 1
}

unplug() {
    kill $usbsim 2>/dev/null || true
    wait $usbsim 2>/dev/null || true
}

# A virtual machine that does not come up on a busy host (status 125) is started once more; its USB device ended with it.
lab() {
    local status=0
    "$lab/lab-run" --timeout 200 --share "$probe" "$@" || status=$?
    if [ "$status" = 125 ]; then
        echo "the virtual machine did not come up; once more"
        if [ -n "$usbsim" ] && ! kill -0 $usbsim 2>/dev/null; then plug_in; fi
        status=0
        "$lab/lab-run" --timeout 200 --share "$probe" "$@" || status=$?
    fi
    return $status
}

step() { # name, then lab-run's arguments
    echo "== $1"
    shift
    lab "$@" 2>&1 | sed 's/^/   /'
}

# The stride of whoever used the node before must not stay.
step "vivid: grey, a stride left behind, more than 8 bits, luma, controls" -c '
    set -e
    wait-for /dev/video0
    v4l2-ctl -d0 --set-fmt-video=width=640,height=480,pixelformat=GREY,bytesperline=1024
    camera_probe --pictures 60 device=\"/dev/video0\" | tee /tmp/said; grep -q "stride: 640," /tmp/said
    for format in Y10 Y12 Y16 YUYV; do
        camera_probe --pictures 30 device=\"/dev/video0\" "pixel_format = \"$format\""
    done
    camera_probe --pictures 30 --size 1280x720 device=\"/dev/video0\" gain=77 "controls = { brightness = 99, \"Gain, Automatic\" = false }"
    ! camera_probe device=\"/dev/video0\" "controls = { warp = 9 }" 2>/tmp/error; grep "no control \"warp\"; it has:.*Brightness" /tmp/error
    ! camera_probe device=\"/dev/video0\" "pixel_format = \"MJPEG\"" 2>/tmp/error; grep "does not send MJPG; it sends" /tmp/error
    ! camera_probe "name = \"nobody\"" 2>/tmp/error; grep "no camera fits; found: /dev/video0" /tmp/error'

step "v4l2loopback: no clock told, a stale first picture, no sender" -c '
    set -e
    wait-for /dev/video10
    vpump /dev/video10 --fps 100 --seconds 25 >/dev/null & pump=$!
    sleep 1
    camera_probe --pictures 300 --period-ms 10 --count-numbers "name = \"lab-cam\"" device=\"/dev/video10\"
    kill $pump; wait $pump || true
    for node in 10 11; do
        ! camera_probe device=\"/dev/video$node\" 2>/tmp/error; grep Error /tmp/error; ! grep panicked /tmp/error
    done'

plug_in
step "USB video class: two nodes, 90 pictures/s, chosen by serial number" --redir "$work/uvc" -c '
    set -e
    wait-for /dev/video1
    camera_probe --pictures 300 --period-ms 11.1111 --count-numbers "serial = \"LAB0002\"" gain=33
    camera_probe --pictures 50 --period-ms 33.3333 --count-numbers "name = \"fringe camera\"" "controls = { auto_exposure = \"Manual Mode\" }"'

echo "== USB video class: unplugged and plugged in again"
unplug
plug_in
lab --redir "$work/uvc" -c '
    wait-for /dev/video1
    echo streaming
    camera_probe --pictures 900 --period-ms 11.1111 --count-numbers --outage "serial = \"LAB0002\""' >"$work/outage" 2>&1 &
run=$!
for _ in $(seq 600); do grep -q streaming "$work/outage" && break; sleep 0.2; done
sleep 4
unplug
sleep 2
plug_in
status=0
wait $run || status=$?
sed 's/^/   /' "$work/outage"
[ $status = 0 ] || { echo "the camera did not come back"; exit 1; }
echo "camera: all well"
