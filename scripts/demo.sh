#!/usr/bin/env bash
# Demonstration: simulate a drive, run the odometry, smooth the run, and print the errors of both; each writes a report.
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
echo "Open the reports: $folder/odometry/report.html and $folder/odometry/smoothed/report.html"
