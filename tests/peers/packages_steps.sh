#!/usr/bin/env bash
# What packages.sh tries, on the copy that it has made: never run it elsewhere.
set -euo pipefail
[ "$(cat /proc/1/environ | tr '\0' '\n' | sed -n 's/^container=//p')" = crossfix-trial ] || exit 1
cd /trial

fail() { echo "FAILED: $*"; journalctl --no-pager -n 40 || true; exit 1; }
say() { echo "  $*"; }
milliseconds() { date +%s%3N; }
# Waits until a command succeeds, at most so many milliseconds, and says how many.
wait_for() {
  local most="$1" begun; begun="$(milliseconds)"; shift
  until "$@" >/dev/null 2>&1; do
    [ $(($(milliseconds) - begun)) -lt "$most" ] || return 1
    sleep 0.05
  done
  echo "$(($(milliseconds) - begun)) ms"
}
pid_of() { systemctl show -p MainPID --value "$1"; }
is_up_anew() {
  systemctl -q is-active "$1" && [ "$(pid_of "$1")" != "$2" ] && [ "$(pid_of "$1")" != 0 ]
}
journal_has() { journalctl --no-pager "${@:2}" | grep -q -- "$1"; }

dpkg -i crossfix.deb >/dev/null
crossfix --version
[ -f /etc/crossfix/README ] || fail "no folder for configurations"
# The lens of the scene's cameras.
cat > /etc/crossfix/north.yaml <<'YAML'
image_width: 640
image_height: 480
camera_matrix: {rows: 3, cols: 3, data: [554.0, 0.0, 319.5, 0.0, 554.0, 239.5, 0.0, 0.0, 1.0]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [0.0, 0.0, 0.0, 0.0, 0.0]}
YAML
cat > /etc/crossfix/network.toml <<'TOML'
site = "trial"
mode = "peer"
fusion = "tcp/127.0.0.1:7450"
[cameras]
north = "tcp/127.0.0.1:7451"
TOML
echo 'network = "network.toml"' > /etc/crossfix/fusion.toml
cat > /etc/crossfix/north.toml <<'TOML'
name = "north"
network = "network.toml"
intrinsics = "north.yaml"
pose = { position_m = [15.0, 120.0, 3.0], look_at_m = [0.0, 0.0, 46.0] }
source = { kind = "stream", url = "rtsp://127.0.0.1:8554/north" }
TOML
sed -i 's/^duration_s.*/duration_s = 120.0/' scene.toml
crossfix simulate scene.toml --rtsp 127.0.0.1:8554 >/dev/null 2>&1 &

agent=crossfix-agent@north
for unit in $agent crossfix-fuse crossfix-record; do
  systemctl start $unit || fail "$unit does not start"
  systemctl -q is-active $unit || fail "$unit is not up"
done
say "installed, and up"
sleep 5
for unit in $agent crossfix-fuse crossfix-record; do
  pid="$(pid_of $unit)"
  kill -9 "$pid"
  # The recorder waits ten seconds, so that a full disk is not tried every second.
  most=2500; [ $unit = crossfix-record ] && most=12500
  took="$(wait_for $most is_up_anew $unit "$pid")" || fail "$unit was killed and is not up after $most ms"
  say "$unit was killed: up after $took"
done
sleep 4
pid="$(pid_of $agent)"
kill -STOP "$pid"
# The watchdog waits five seconds, and the start anew one.
took="$(wait_for 9000 is_up_anew $agent "$pid")" || fail "$agent hangs and nobody minds"
say "$agent hung: up after $took"
sleep 1
sed -i 's/120.0, 3.0/120.0, 4.0/' /etc/crossfix/north.toml
systemctl reload $agent
took="$(wait_for 3000 journal_has 'is read again' -u $agent)" || fail "a reload is not heard"
say "$agent read its file again after $took"
# Levels and the name are fields of the journal.
journal_has 'is read again' -t crossfix -p info -u $agent || fail "the journal has no fields"
if journal_has 'is read again' -t crossfix -p warning; then fail "what is no warning is one"; fi
sleep 4
systemctl stop crossfix-record
recordings=(/var/lib/crossfix/*.mcap)
[ ${#recordings[@]} = 2 ] || fail "a recorder that was killed once has written ${recordings[*]}"
for file in "${recordings[@]}"; do
  crossfix info "$file" > info.txt 2>&1 || { cat info.txt; fail "$file cannot be read"; }
  grep -q 'north/bearings' info.txt || { cat info.txt; fail "$file has no bearings"; }
  if grep -q 'received_missing\|received_dropped' info.txt; then cat info.txt; fail "messages are lost"; fi
done

dpkg -r crossfix >/dev/null
if systemctl -q is-active $agent; then fail "it runs on without its program"; fi
if [ -e /usr/bin/crossfix ]; then fail "the program is still there"; fi
[ -f /etc/crossfix/north.toml ] || fail "the site's files are gone"
[ -f "${recordings[0]}" ] || fail "recordings are gone"
dpkg -P crossfix >/dev/null 2>&1
dpkg -i agent.deb >/dev/null
systemctl start $agent || fail "the camera host's package does not start an agent"
pid="$(pid_of $agent)"
dpkg -i crossfix.deb >/dev/null 2>&1
if dpkg -s crossfix-agent 2>/dev/null | grep -q '^Status: .* installed'; then fail "both packages are there"; fi
wait_for 3000 is_up_anew $agent "$pid" >/dev/null || fail "the fusion centre's package in the place of the agent's stops the agent"
dpkg -P crossfix >/dev/null
say "removed; the site's files and recordings stay"
echo PASSED
