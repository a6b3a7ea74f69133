#!/usr/bin/env bash
# The serial trigger controller behind a real kernel's cdc-acm driver, in the virtual-machine lab: a USB gadget whose far end is
# the protocol's model, unplugged and plugged in again while it fires, wanted by two at once, and a port that echoes instead of
# answering. Exit code 0 when all is well or there is no lab, 1 otherwise.
. "$(dirname "$0")/common.sh"
share_example gv3-tests trigger_probe

machine --timeout 250 --share "$work/share/trigger_probe" -c '
    set -e
    echo "== a port that echoes is no controller"
    usbsim vendor >/dev/null 2>&1 & echo_device=$!
    wait-for -t 60 /dev/ttyACM0
    ! trigger_probe host "port = \"/dev/ttyACM0\"" 2>/tmp/error
    grep "no trigger controller answers" /tmp/error
    kill $echo_device
    echo "== a controller behind cdc-acm, found by its serial number"
    modprobe -a dummy_hcd libcomposite usb_f_acm
    mount -t configfs configfs /sys/kernel/config 2>/dev/null || true
    gadget=/sys/kernel/config/usb_gadget/trigger
    mkdir -p $gadget/strings/0x409 $gadget/configs/c.1 $gadget/functions/acm.0
    echo 0x1209 >$gadget/idVendor; echo 0x0013 >$gadget/idProduct; echo LAB-T1 >$gadget/strings/0x409/serialnumber
    ln -s $gadget/functions/acm.0 $gadget/configs/c.1
    plug_in() {
        echo dummy_udc.0 >$gadget/UDC
        wait-for -t 60 /dev/ttyGS0
        trigger_probe board /dev/ttyGS0 & board=$!
    }
    plug_in
    for attempt in $(seq 300); do grep -qs LAB-T1 /sys/bus/usb/devices/*/serial && break; sleep 0.1; done
    sleep 1
    trigger_probe host "serial = \"LAB-T1\""
    trigger_probe host "serial = \"LAB-T1\"" report_every=6
    echo "== wanted by another program, unplugged and plugged in again"
    trigger_probe host --outage "serial = \"LAB-T1\"" >/tmp/said 2>&1 & host=$!
    for attempt in $(seq 600); do grep -q "ready for the outage" /tmp/said && break; sleep 0.1; done
    ! trigger_probe host "serial = \"LAB-T1\"" 2>/tmp/error
    grep "in use by another program" /tmp/error
    echo "" >$gadget/UDC
    # Without its port it may have ended already.
    kill $board 2>/dev/null || true
    sleep 1
    plug_in
    wait $host || { cat /tmp/said; exit 1; }
    cat /tmp/said
    kill $board || true' | sed 's/^/   /'
echo "trigger: all well"
