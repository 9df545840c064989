#!/usr/bin/env bash
# The main job by the public commands: simulate a drive, run the odometry, smooth it, evaluate both, leave reports.
# Usage: demo.sh [FOLDER] [SECONDS]
set -euo pipefail

folder=${1:-demo}
seconds=${2:-60}
read -r -a hybridlio <<<"${HYBRIDLIO:-hybridlio}"

"${hybridlio[@]}" simulate "$folder/drive" --seconds "$seconds" --seed 1
"${hybridlio[@]}" odometry "$folder/drive" -o "$folder/runs"
"${hybridlio[@]}" smooth "$folder/runs/latest" --loops -o "$folder/smoothed"
