"""How fast a run's report opens in headless Chromium, and pictures of it on a desk and on a phone.

    python benchmarks/report_page.py REPORT.html… [--pictures FOLDER] [--repeats N]

Prints the size, the first contentful paint of each opening (by the browser's own clock, from the start of the
navigation; the profile is new each time, so nothing is cached), and what the page logs to the console. With
``--pictures`` it saves the page at 1280 and 390 px for looking at.
"""

from __future__ import annotations

import argparse
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from hybridlio.core import tables

WIDTHS_PX = (1280, 390)
_HEIGHT_PX = 4000
_LEAST_WIDTH_PX = 500  # of a window; narrower pages are shown in a frame
_OBSERVER = """<script>new PerformanceObserver(list => list.getEntries().forEach(entry =>
  console.log("PAINT " + entry.name + " " + entry.startTime))).observe({type: "paint", buffered: true});</script>"""


def browse(page: Path, *options: str) -> str:
    """Open a page in a new profile and return what the browser logs."""
    browser = shutil.which("chromium") or shutil.which("google-chrome") or shutil.which("chromium-browser")
    if browser is None:
        sys.exit("error: no Chromium or Chrome found; install the package chromium")
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        words = [browser, "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars"]
        words += ["--enable-logging=stderr", "--allow-file-access-from-files", f"--user-data-dir={profile}"]
        done = subprocess.run(
            [*words, *options, page.as_uri()], capture_output=True, text=True, timeout=300, check=True
        )
    return done.stderr


def first_paint_ms(page: Path, folder: Path) -> tuple[float, list[str]]:
    """Return the time of the first contentful paint, and the other lines of the console."""
    watched = folder / "watched.html"
    watched.write_text(page.read_text().replace("<head>", f"<head>{_OBSERVER}", 1))
    lines = re.findall(
        r'CONSOLE[^"]*"(.*?)"', browse(watched, "--window-size=1280,900", f"--screenshot={folder / 'x.png'}")
    )
    paints = [float(line.split()[-1]) for line in lines if line.startswith("PAINT first-contentful-paint")]
    return paints[0] if paints else float("nan"), [line for line in lines if not line.startswith("PAINT")]


def take_picture(page: Path, width_px: int, picture: Path, folder: Path) -> None:
    """Save a picture of a page, with its charts drawn."""
    shown = page
    if width_px < _LEAST_WIDTH_PX:
        shown, style = folder / "frame.html", f"border:0;width:{width_px}px;height:{_HEIGHT_PX}px"
        shown.write_text(f'<body style="margin:0"><iframe src="{page.as_uri()}" style="{style}"></iframe>')
    size = f"--window-size={max(width_px, _LEAST_WIDTH_PX)},{_HEIGHT_PX}"
    browse(shown, size, "--virtual-time-budget=30000", f"--screenshot={picture}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("reports", type=Path, nargs="+")
    parser.add_argument("--pictures", type=Path)
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    rows = []
    for page in (report.resolve() for report in options.reports):
        with tempfile.TemporaryDirectory() as folder:
            found = [first_paint_ms(page, Path(folder)) for _ in range(options.repeats)]
            paints = [ms for ms, _ in found]
            logged = sorted({line for _, lines in found for line in lines})
            rows.append(
                {
                    "run": page.parent.name,
                    "MB": f"{page.stat().st_size / 1e6:.1f}",
                    "first paint, median [ms]": f"{np.median(paints):.0f}",
                    "longest [ms]": f"{max(paints):.0f}",
                    "console": "; ".join(logged),
                }
            )
            for width_px in WIDTHS_PX if options.pictures else ():
                options.pictures.mkdir(parents=True, exist_ok=True)
                picture = options.pictures.resolve() / f"{page.parent.name}-{width_px}.png"
                take_picture(page, width_px, picture, Path(folder))
    print(tables.to_markdown(rows, words=("run", "console")))


if __name__ == "__main__":
    main()
