#!/bin/sh
# First process of the CAN machine: load the modules, mount the host's files, set up the interfaces, run /command in
# the host's tree, switch off. On the control port it says `ready` before the command starts and `exit CODE` when
# the files are written back.
export PATH=/bin
/bin/busybox mkdir -p /proc /sys /dev /host
/bin/busybox --install -s /bin
mount -t proc proc /proc
mount -t sysfs sysfs /sys
mount -t devtmpfs devtmpfs /dev

fail() {
  echo "can-vm: $*" >/dev/console
  sync
  poweroff -f
}

while read -r module; do
  insmod "/modules/$module.ko" || fail "kernel module $module does not load"
done </modules/order

mkdir /ports
for port in /sys/class/virtio-ports/*; do
  ln -s "/dev/${port##*/}" "/ports/$(cat "$port/name")"
done
exec 7<>/ports/control || fail "no control port"
# A line on the control port ends the command; its end means that the caller has died, so nobody takes what we write.
(
  read -r _ <&7
  alone=$?
  trap "" TERM # from below, where the command has ended
  [ -e /pid ] && kill -TERM "-$(cat /pid)"
  [ $alone -eq 0 ] && exit
  sleep 2
  sync
  poweroff -f
) &
watch=$!

mount -t 9p -o trans=virtio,version=9p2000.L,cache=loose,msize=512000 host /host || fail "cannot mount the host's files"
mkdir /dev/pts /dev/shm
mount -t devpts -o ptmxmode=0666 devpts /dev/pts
mount -t tmpfs -o mode=1777 tmpfs /dev/shm
ln -s /proc/self/fd /dev/fd
ln -s /proc/self/fd/0 /dev/stdin
ln -s /proc/self/fd/1 /dev/stdout
ln -s /proc/self/fd/2 /dev/stderr
for place in proc sys dev; do
  mount -o rbind "/$place" "/host/$place" || fail "the host's tree has no /$place"
done
mount -t tmpfs -o mode=755 tmpfs /host/run || fail "the host's tree has no /run"
hostname can-machine

mkdir /host/run/can-vm
cp /command /interfaces /host/run/can-vm/
ip='PATH=/usr/sbin:/sbin:/usr/bin:/bin exec ip -batch /run/can-vm/interfaces'
chroot /host /bin/sh -c "$ip" </dev/null >/dev/console 2>&1 || fail "cannot set up the CAN interfaces"
# The kernel tells that an interface runs up to a second after it has been brought up.
for attempt in 1 2 3 4 5 6 7 8 9 10 11 12 13 14 15 16 17 18 19 20; do
  grep -qx down /sys/class/net/*/operstate || break
  sleep 0.2
done

# The command writes into pipes because a port can be opened only once, which would break /dev/stderr.
mkfifo /stdout /stderr
cat </stdout >/ports/stdout 7>&- &
cat </stderr >/ports/stderr 7>&- &
echo ready >&7
setsid chroot /host /bin/sh /run/can-vm/command </dev/null >/stdout 2>/stderr 7>&- &
command=$!
echo $command >/pid
wait $command
code=$?
kill $watch 2>/dev/null

# What the command left behind would hold the pipes open; everything it started has the host's tree as its root.
for process in /proc/[0-9]*; do
  [ "$(readlink "$process/root")" = /host ] && kill -KILL "${process##*/}"
done
wait
sync
echo "exit $code" >&7
poweroff -f
