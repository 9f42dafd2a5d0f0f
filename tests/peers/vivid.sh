#!/bin/sh
# Cameras of this host, tried on the kernel's own test camera: sh tests/peers/vivid.sh target/release/crossfix
# As root, on a kernel with modules (a virtual machine will do), with v4l2-ctl (apt-get install v4l-utils).
set -eu
crossfix=$(readlink -f "$1")
modprobe vivid n_devs=1
sleep 1
device=/dev/$(basename "$(dirname "$(grep -l '^vivid-000-vid-cap' /sys/class/video4linux/*/name)")")
works=$(mktemp -d)
trap 'rm -r "$works"; modprobe -r vivid || true' EXIT

# What `sources` prints as JSON: the number of a key.
number() { sed -n "s/^ *\"$1\": \([-0-9.e]*\),*$/\1/p" "$works/tried.json"; }
holds() { awk "BEGIN { exit !($1) }" || { echo "FAILED: $1"; cat "$works/tried.json"; exit 1; }; }
try() { "$crossfix" sources "$device" "$@" --json > "$works/tried.json"; }

"$crossfix" sources | grep "$device"

# Both kinds of time stamps, at a size that it has.
for start_of_exposure in 0 1; do
    v4l2-ctl -d "$device" -c timestamp_source=$start_of_exposure
    try --size 320x180 --seconds 4 --picture "$works/picture.jpg"
    holds "$(number width) == 320 && $(number height) == 180 && $(number bad_frames) == 0"
    holds "$(number rate_hz) > 50 && $(number arrival_after_capture_s)^2 < 0.03^2"
done
[ "$(wc -c < "$works/picture.jpg")" -gt 1000 ]

# A size that it has not is said, and nothing comes.
if "$crossfix" sources "$device" --size 333x77 --seconds 2 > "$works/said"; then exit 1; fi
grep -q "no images of 333x77" "$works/said"

# What the driver drops is missed; what it spoils is counted.
v4l2-ctl -d "$device" -c percentage_of_dropped_buffers=20
try --size 320x180 --seconds 4
holds "$(number rate_hz) < 52 && $(number rate_hz) > 40"
v4l2-ctl -d "$device" -c percentage_of_dropped_buffers=0

# Unplugged, and back: it is said, and images come again.
(sleep 2 && v4l2-ctl -d "$device" -c disconnect=1) &
try --size 320x180 --seconds 7
grep -q "unplugged" "$works/tried.json"
holds "$(number frames) > 150"
wait
echo "cameras of this host: good"
