#!/usr/bin/env bash
# Installs the packages on a copy of this machine, with a systemd of its own, and sees the site's parts
# start, die, hang, be told to read their files again, and be removed. Nothing of it touches the machine:
# files go to an overlay in memory, processes and network are namespaces of their own.
#
#   cargo deb -p crossfix -o FOLDER && cargo deb -p crossfix --variant agent -o FOLDER
#   bash tests/peers/packages.sh FOLDER
#
# Needs root and systemd; says SKIPPED where it has not what it needs.
set -euo pipefail

skip() { echo "SKIPPED: $*"; exit 0; }
[ "$(id -u)" = 0 ] || skip "only root can make namespaces"
[ -x /lib/systemd/systemd ] || skip "there is no systemd"
command -v dpkg >/dev/null || skip "there is no dpkg"

packages="$(cd "$1" && pwd)"
top="$(cd "$(dirname "$0")/../.." && pwd)"
trial="$(mktemp -d)"
trap 'rm -rf "$trial"' EXIT
cp "$packages"/crossfix_*.deb "$trial/crossfix.deb"
cp "$packages"/crossfix-agent_*.deb "$trial/agent.deb"
cp "$top/configs/demo/scene.toml" "$top/tests/peers/packages_steps.sh" "$trial/"

# PID 1 of the copy.
cat > "$trial/enter.sh" <<'ENTER'
#!/usr/bin/env bash
set -euo pipefail
trial="${1:?}"
ip link set lo up
mount --make-rprivate /
mount -t tmpfs tmpfs /mnt
mkdir /mnt/upper /mnt/work /mnt/root
mount -t overlay overlay -o lowerdir=/,upperdir=/mnt/upper,workdir=/mnt/work /mnt/root
root=/mnt/root
mkdir -p $root/trial
mount --bind "$trial" $root/trial
mount -t proc proc $root/proc
mount -t sysfs -o ro sysfs $root/sys
mount -t cgroup2 cgroup2 $root/sys/fs/cgroup
# Devices of its own: systemd makes links among them.
mount -t tmpfs tmpfs $root/dev
mkdir $root/dev/shm $root/dev/pts
for device in null:3 zero:5 full:7 random:8 urandom:9; do
  mknod -m 666 "$root/dev/${device%:*}" c 1 "${device#*:}"
done
mknod -m 666 $root/dev/tty c 5 0
mount -t tmpfs tmpfs $root/run
mount -t tmpfs tmpfs $root/tmp
mount -t tmpfs tmpfs $root/etc/systemd/system
mount --bind $root/proc/sys $root/proc/sys
mount -o remount,ro,bind $root/proc/sys
cat > $root/etc/systemd/system/trial.target <<'UNIT'
[Unit]
DefaultDependencies=no
Requires=systemd-journald.service trial.service
UNIT
cat > $root/etc/systemd/system/trial.service <<'UNIT'
[Unit]
DefaultDependencies=no
After=systemd-journald.service
[Service]
Type=oneshot
Environment=PATH=/usr/sbin:/usr/bin:/sbin:/bin
ExecStart=/bin/bash -c 'bash /trial/packages_steps.sh > /trial/said 2>&1; systemctl exit --force --force'
UNIT
export container=crossfix-trial
exec chroot $root /lib/systemd/systemd --system --unit=trial.target --log-target=null --show-status=no
ENTER

# A control group of its own: systemd takes the one that it is in for all there is.
groups="$(findmnt -n -o TARGET -t cgroup2 | head -1)"
group="$groups/crossfix-trial-$$"
[ -n "$groups" ] && mkdir "$group" 2>/dev/null || skip "there are no control groups of the second version"
trap 'find "$group" -depth -type d -exec rmdir {} \; 2>/dev/null; rm -rf "$trial"' EXIT

(
  echo "$BASHPID" > "$group/cgroup.procs"
  exec timeout -s KILL 180 unshare --kill-child -fpmuinC --mount-proc bash "$trial/enter.sh" "$trial" >/dev/null 2>"$trial/system"
) || true
cat "$trial/said" 2>/dev/null || { cat "$trial/system"; echo "FAILED: the copy did not start"; exit 1; }
grep -q '^PASSED$' "$trial/said"
