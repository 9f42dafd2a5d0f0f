#!/usr/bin/env bash
# Replays the recorded bearings of configs/drone-tracking/half.mcap by three agent processes over Zenoh
# into the fusion centre, ten times as fast as life, and records what comes out to the given file.
set -euo pipefail
output=${1:?usage: run.sh TRACKS.mcap}
cd "$(dirname "$0")/../.."
crossfix=${CROSSFIX:-target/release/crossfix}
here=configs/drone-tracking

"$crossfix" record -c $here/network.toml -o "$output" --overwrite & recorder=$!
"$crossfix" fuse -c $here/fusion.toml & fusion=$!
trap 'kill $recorder $fusion 2>/dev/null || true' EXIT
agents=()
for camera in gopro3 sony5100 sonyG; do
  "$crossfix" agent -c $here/$camera.toml --wait-for-recorder & agents+=($!)
done
wait "${agents[@]}"
kill -TERM $fusion; wait $fusion
kill -TERM $recorder; wait $recorder
trap - EXIT
