#!/usr/bin/env bash
# The main job by the public commands: simulate a drive, run the odometry, smooth it, say how good both are, leave reports.
# Usage: demo.sh [FOLDER] [SECONDS]
set -euo pipefail

folder=${1:-demo}
seconds=${2:-60}
read -r -a hybridlio <<<"${HYBRIDLIO:-hybridlio}"

step() {
    echo
    echo "\$ hybridlio $*"
    "${hybridlio[@]}" "$@"
}

step simulate "$folder/drive-${seconds}s" --seconds "$seconds" --seed 1
step odometry "$folder/drive-${seconds}s" -o "$folder/odometry" --overwrite
step smooth "$folder/odometry"

echo
echo "Everything is in $folder; open $folder/odometry/report.html and $folder/odometry/smoothed/report.html"
