#!/usr/bin/env bash
# Install the system libraries that Open3D needs to be imported, by apt-get if possible; otherwise print how.
# Usage: system-libraries.sh PYTHON
set -euo pipefail

python=${1:-python3}
packages=(libusb-1.0-0 libgl1 libegl1 libx11-6 libgomp1)

all_there() {
    "$python" - <<'PY'
import ctypes
for name in ("libusb-1.0.so.0", "libGL.so.1", "libEGL.so.1", "libX11.so.6", "libgomp.so.1"):
    ctypes.CDLL(name)
PY
}

all_there 2>/dev/null && exit 0

root=()
[ "$(id -u)" -eq 0 ] || root=(sudo -n)
if command -v apt-get >/dev/null && "${root[@]}" true 2>/dev/null; then
    echo "installing the system libraries that Open3D needs: ${packages[*]}"
    export DEBIAN_FRONTEND=noninteractive
    { "${root[@]}" apt-get update -qq && "${root[@]}" apt-get install -y -qq --no-install-recommends "${packages[@]}"; } >/dev/null || true
fi
all_there 2>/dev/null && exit 0
echo "Open3D needs missing system libraries; run: sudo apt-get install ${packages[*]}" >&2
exit 1
