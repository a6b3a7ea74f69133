#!/usr/bin/env bash
# The V4L2 camera against real kernel drivers, in the virtual-machine lab: vivid, v4l2loopback and a simulated USB video class
# device, unplugged and plugged in again while it streams, and taken by two at once. Exit code 0 when all is well or there is no
# lab, 1 otherwise.
. "$(dirname "$0")/common.sh"
share_example gv3-tests camera_probe

step() { # name, then lab-run's arguments
    echo "== $1"
    shift
    machine --timeout 250 --share "$work/share/camera_probe" "$@" 2>&1 | sed 's/^/   /'
}

# The stride of whoever used the node before must not stay.
step "vivid: grey, a stride left behind, more than 8 bits, luma, controls" -c '
    set -e
    wait-for -t 60 /dev/video0
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
    wait-for -t 60 /dev/video10
    vpump /dev/video10 --fps 100 --seconds 200 >/dev/null & pump=$!
    sleep 1
    camera_probe --pictures 300 --period-ms 10 --count-numbers --stale-first "name = \"lab-cam\"" device=\"/dev/video10\"
    kill $pump; wait $pump || true
    for node in 10 11; do
        ! camera_probe device=\"/dev/video$node\" 2>/tmp/error; grep Error /tmp/error; ! grep panicked /tmp/error
    done'

plug_in_camera() {
    plug_in "$work/uvc" "$cache/target/release/usbsim" uvc --super --redir "$work/uvc"
}
before_machine() {
    pull_out
    plug_in_camera
}
step "USB video class: two nodes, 90 pictures/s, chosen by serial number, taken by another" --redir "$work/uvc" -c '
    set -e
    wait-for -t 60 /dev/video1
    camera_probe --pictures 300 --period-ms 11.1111 --count-numbers "serial = \"LAB0002\"" gain=33
    camera_probe --pictures 50 --period-ms 33.3333 --count-numbers "name = \"fringe camera\"" "controls = { auto_exposure = \"Manual Mode\" }"
    camera_probe --pictures 900 --period-ms 11.1111 "serial = \"LAB0002\"" >/tmp/first & first=$!
    for attempt in $(seq 300); do grep -q streaming /tmp/first && break; sleep 0.1; done
    ! camera_probe "serial = \"LAB0002\"" 2>/tmp/error; grep "another program" /tmp/error
    wait $first; tail -n 1 /tmp/first'

echo "== USB video class: unplugged and plugged in again"
machine --timeout 250 --share "$work/share/camera_probe" --redir "$work/uvc" -c '
    wait-for -t 60 /dev/video1
    camera_probe --pictures 900 --period-ms 11.1111 --count-numbers --outage "serial = \"LAB0002\""' >"$work/outage" 2>&1 &
run=$!
wait_for "the stream" grep -q streaming "$work/outage" || { cat "$work/outage"; fail "no stream"; }
pull_out
sleep 2
plug_in_camera
status=0
wait $run || status=$?
sed 's/^/   /' "$work/outage"
[ $status = 0 ] || fail "the camera did not come back"
echo "camera: all well"
