#!/bin/sh
# The first process of the user-mode kernel. The machine's / is the root, and read-only; programs get a copy of it that
# they may write to, and that lives in memory. Only the folder of this script is the real one: results go there.
# It holds: insmod (a program), modules (their folder), command (what to run); and gets: code (how that ended).

set -eu
PATH=/usr/sbin:/usr/bin:/sbin:/bin
here=$(dirname "$0")

finish() {
    echo o >/proc/sysrq-trigger
    while :; do read -r _ || exec sleep 60; done
}
trap finish EXIT

mount -t proc proc /proc
mount -t tmpfs tmpfs /mnt
mkdir /mnt/upper /mnt/work /mnt/root
modules=$(cat "$here/modules")/$(uname -r)/kernel

load() {
    for module; do "$here/insmod" "$modules/$module.ko"; done
}

load fs/overlayfs/overlay
mount -t overlay overlay -o lowerdir=/,upperdir=/mnt/upper,workdir=/mnt/work /mnt/root
mount -t proc proc /mnt/root/proc
mount -t sysfs sysfs /mnt/root/sys
mount -t devtmpfs devtmpfs /mnt/root/dev
mkdir -p /mnt/root/dev/pts /mnt/root/dev/shm
mount -t devpts devpts /mnt/root/dev/pts
mount -t tmpfs tmpfs /mnt/root/dev/shm
mount -t hostfs none -o "$here" "/mnt/root$here"
load net/can/can net/can/can-raw net/can/can-bcm net/can/can-gw
load drivers/net/can/dev/can-dev drivers/net/can/vcan drivers/net/can/slcan/slcan
load net/sched/sch_netem
ip link set lo up

code=0
chroot /mnt/root /bin/sh "$here/command" || code=$?
echo "$code" >"/mnt/root$here/code"
