#!/bin/bash
# First process of a Linux that runs as an ordinary program (user-mode Linux) with the host's files as its root.
# The kernel's command line hands over: WORK = folder for results, DINRAIL = the executable, PYTHON = a python with the
# peers, SCRIPT = what to run.
# There is no exit code: the script writes what it finds to WORK, and WORK/done says that it came to its end.
export PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin
export HOME=/tmp
mount -t proc proc /proc
mount -t sysfs sysfs /sys
# The host's /tmp is hidden from here on, but for the folders below it that hold what is to be run.
needed=$(for path in "$WORK" "$SCRIPT" "$DINRAIL" "$PYTHON"; do
    case $path in /tmp/*) path=${path#/tmp/} && echo "${path%%/*}" ;; esac
done | sort -u)
mount -t tmpfs -o mode=1777,exec tmpfs /tmp
for folder in $needed; do
    mkdir -p "/tmp/$folder" && mount -t hostfs -o "/tmp/$folder" none "/tmp/$folder"
done
mkdir -p /dev/shm /dev/pts
mount -t tmpfs -o mode=1777 tmpfs /dev/shm
mount -t devpts devpts /dev/pts
ip link set lo up
modules=/usr/lib/uml/modules/$(uname -r)/kernel
for module in net/can/can net/can/can-raw net/can/can-bcm drivers/net/can/dev/can-dev drivers/net/can/vcan drivers/net/can/slcan/slcan; do
    insmod "$modules/$module.ko" 2>>"$WORK/insmod.log"
done
ip link add dev vcan0 type vcan mtu 72 && ip link set vcan0 up && touch "$WORK/booted"
# What a stack needs of its temporary folder.
cp /bin/true /tmp/exec-check && /tmp/exec-check && rm /tmp/exec-check && touch "$WORK/exec"
UML=$(dirname "$SCRIPT")
export UML
bash "$SCRIPT" >"$WORK/script.log" 2>&1
echo "$?" >"$WORK/done"
sync
halt -f || echo o >/proc/sysrq-trigger
