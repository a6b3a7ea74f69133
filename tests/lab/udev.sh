#!/usr/bin/env bash
# The rules of udev/70-gv3.rules in the virtual-machine lab, with a real udev and real drivers: mode and group of every node,
# access for a member of the group and for nobody else, the uaccess tag.
#
# The vendor's device and its serial port come from the lab's own simulator, the DLPC350 (0451:6401) from
# `gv3 virtual-scanner --attach` in the guest. Exit code 0 when all is well or there is no lab, 1 otherwise.
. "$(dirname "$0")/common.sh"
share_gv3
# shellcheck disable=SC2016
machine --udev --timeout 300 --share udev/70-gv3.rules "$work/share/gv3" -c '
bad=0
check() { if [ "$2" = "$3" ]; then echo "ok   $1: $2"; else echo "FAIL $1: $2, expected $3"; bad=1; fi; }
node() { # name node
  check "$1 mode and group" "$(stat -c %a:%G $2)" 660:plugdev
  check "$1 for a member of plugdev" "$(su -s /bin/sh member -c ": <>$2" 2>/dev/null && echo yes || echo no)" yes
  check "$1 for another user" "$(su -s /bin/sh user -c ": <>$2" 2>/dev/null && echo yes || echo no)" no
  udevadm test "$(udevadm info -q path -n $2)" >/tmp/test 2>&1
  check "$1 uaccess" "$(udevadm info -q property -n $2 | grep -c "^TAGS=.*:uaccess:")" 1
  check "$1 rule in udevadm test" "$(grep -c "GROUP .*70-gv3.rules\|70-gv3.rules.*GROUP" /tmp/test | sed "s/[1-9][0-9]*/yes/")" yes
}
usb_node() { # vendor product
  for d in /sys/bus/usb/devices/*; do
    [ "$(cat $d/idVendor 2>/dev/null):$(cat $d/idProduct 2>/dev/null)" = "$1:$2" ] || continue
    printf "/dev/bus/usb/%03d/%03d" "$(cat $d/busnum)" "$(cat $d/devnum)"; return
  done
}
echo "member:x:1001:1001:member:/tmp:/bin/sh" >>/etc/passwd
echo "member:x:1001:" >>/etc/group
sed -i "s/^plugdev:.*/plugdev:x:46:member/" /etc/group
usbsim vendor >/dev/null 2>&1 &
wait-for -t 60 /dev/ttyACM0; udevadm settle
node vendor "$(usb_node 1209 0001)"
node trigger /dev/ttyACM0
check "trigger left alone by ModemManager" "$(udevadm info -q property -n /dev/ttyACM0 | grep ID_MM_PORT_IGNORE)" ID_MM_PORT_IGNORE=1
# The same simulator shows a HID interface that is no DLPC350: it stays root alone.
[ -e /dev/hidraw0 ] && check "another HID device" "$(stat -c %a:%G /dev/hidraw0)" 600:root
gv3 virtual-scanner --attach --devices projector --projector dlpc350 >/tmp/virtual-scanner 2>&1 &
for i in $(seq 300); do dlpc=$(usb_node 0451 6401); [ -n "$dlpc" ] && break; usleep 100000; done
udevadm settle
node "DLPC350 USB device" "$dlpc"
for h in /sys/class/hidraw/*; do grep -q "^HID_ID=.*:00000451:00006401" $h/device/uevent && raw=/dev/${h##*/}; done
node "DLPC350 hidraw" "$raw"
exit $bad'
echo "udev: all well"
