"""Dragging a landmark in the page, end to end in headless Chromium: where it ends, and how often a new image is shown.

    python tests/benchmarks/page_drag.py [CHECKOUT ...] [--seconds S] [--repeat R] [--landmarks N] [--side PIXELS]

Two square images with N landmarks are opened. One is dragged by 1, 2, 5 and 20 pixels of the screen, at once, in two
seconds, and after it was held for half a second, and how far it ends from the pointer is measured. Then it is dragged
along a circle for S seconds by a mouse that moves every 16 ms; counted are the warped images that reached the page and
were painted. Several checkouts take turns, so that they meet the same load; the processor's time, of the server and of
the browser, says what one image costs. Without the argument the checkout that holds this file is measured.
Needs Chromium and playwright.
"""

import argparse
import os
import statistics
import sys
import tempfile
from pathlib import Path
from time import perf_counter

import numpy as np
from rich.console import Console
from rich.table import Table

from codegen.registration.formats import write_landmarks
from codegen.registration.images import write_image
from codegen.registration.pairs import LandmarkPairs

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "tests" / "registration"))

from browser import Visit, browser, server  # noqa: E402 (beside the tests, which use it as well)

EVERY = 0.016
"""Seconds between moves of the mouse."""
RADIUS = 14.0
"""Of the circle along which the landmark is dragged, in pixels of the image."""

DISTANCES = (1, 2, 5, 20)
"""Pixels of the screen by which a landmark is dragged, to see where it ends."""
WAYS = {"at once": {"moves": 1}, "over 2 s": {"seconds": 2.0}, "held first": {"hold": 500}}

# What the page does with a picture that has come is over when it is painted.
_COUNT = """() => {
  const { link } = window.__page, seen = window.__seen = { images: [], sizes: [] }, packed = link.onPacked
  link.onPacked = async (header, image) => {
    await packed(header, image)
    if (header.type !== "frame") return
    seen.images.push(performance.now())
    seen.sizes.push(image.data.length)
  }
}"""


def images(folder: Path, side: int, landmarks: int) -> None:
    """Two smooth images with some noise, and landmarks that move by about a fiftieth of the side."""
    random = np.random.default_rng(1)
    y, x = np.indices((side, side))
    for name in ("moving", "fixed"):
        layers = [127 + 100 * np.sin(x / a) * np.cos(y / b) for a, b in ((31, 47), (60, 37), (41, 80))]
        noisy = np.stack(layers, axis=-1) + random.normal(size=(side, side, 3)) * 8.0
        write_image(folder / f"{name}.png", np.clip(noisy, 0, 255).astype(np.uint8))
    grid = np.stack(np.meshgrid(*[np.linspace(0.15, 0.85, 5)] * 2), axis=-1).reshape(-1, 2)
    start = side * (
        grid[random.permutation(25)[: min(landmarks, 25)]] + random.normal(size=(min(landmarks, 25), 2)) / 60
    )
    write_landmarks(
        folder / "pairs.csv", pairs=LandmarkPairs(start, start + random.normal(size=start.shape) * side / 60)
    )


def processor_times(pid: int) -> dict[int, float]:
    """Seconds of processor time of a process and all that it started, by their numbers."""
    parents, spent = {}, {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                words = (entry / "stat").read_text().rpartition(")")[2].split()
            except OSError:
                continue
            parents[int(entry.name)] = int(words[1])
            spent[int(entry.name)] = (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")

    def belongs(one: int) -> bool:
        while one not in (0, pid):
            one = parents.get(one, 0)
        return one == pid

    return {one: seconds for one, seconds in spent.items() if belongs(one)}


def spent_by(name: str) -> float:
    """Seconds of processor time of those of this program's descendants whose command line holds a word."""
    total = 0.0
    for pid, seconds in processor_times(os.getpid()).items():
        try:
            command = Path(f"/proc/{pid}/cmdline").read_bytes()
        except OSError:
            continue
        total += seconds if name.encode() in command else 0.0
    return total


def misplaced(visit: Visit, **values: float) -> float:
    """The farthest, in pixels of the screen, that a landmark is from the pointer after drags by DISTANCES."""
    worst = 0.0
    for distance in DISTANCES:
        start = visit.points("fixed")[0]
        wanted = np.add(visit.screen("fixed", start), (distance, 0.0))
        visit.drag("fixed", start, (distance, 0.0), **values)
        visit.page.wait_for_timeout(300)
        worst = max(worst, float(np.linalg.norm(visit.screen("fixed", visit.points("fixed")[0]) - wanted)))
    return worst


def dragged(visit: Visit, seconds: float) -> dict[str, float]:
    """Drag the first landmark of the fixed image, and say what was seen meanwhile."""
    x, y = visit.points("fixed")[0]
    centre, edge = np.array(visit.screen("fixed", (x, y))), np.array(visit.screen("fixed", (x + RADIUS, y)))
    radius = edge[0] - centre[0]
    visit.page.mouse.move(*centre)
    visit.page.mouse.down()
    visit.page.mouse.move(centre[0] + radius, centre[1])
    visit.page.wait_for_timeout(500)
    visit.page.evaluate(_COUNT)
    begin, before = perf_counter(), [spent_by("codegen"), spent_by("chrom")]
    while (now := perf_counter() - begin) < seconds:
        angle = 2.0 * np.pi * now / 2.0
        visit.page.mouse.move(centre[0] + radius * np.cos(angle), centre[1] + radius * np.sin(angle))
        visit.page.wait_for_timeout(max(0.0, EVERY - (perf_counter() - begin - now)) * 1000)
    wall, after = perf_counter() - begin, [spent_by("codegen"), spent_by("chrom")]
    seen = visit.page.evaluate("window.__seen")
    visit.page.mouse.up()
    count = max(1, len(seen["images"]))
    gaps = np.diff(seen["images"]) if count > 1 else np.array([wall * 1000])
    return {
        "images a second": len(seen["images"]) / wall,
        "longest gap, ms": float(gaps.max()),
        "server, ms an image": 1000 * (after[0] - before[0]) / count,
        "browser, ms an image": 1000 * (after[1] - before[1]) / count,
        "bytes an image": statistics.fmean(seen["sizes"]) if seen["sizes"] else 0.0,
    }


def measure(checkout: Path, folder: Path, seconds: float, chromium: object) -> dict[str, float]:
    """One visit of the page of a checkout."""
    here, kept = os.getcwd(), os.environ.get("PYTHONPATH", "")
    os.environ["PYTHONPATH"] = str(checkout)
    os.chdir(checkout)
    try:
        with server(folder / "state", folder / "moving.png", folder / "fixed.png") as address:
            visit = Visit(chromium, address)
            visit.wait_for("no pairs yet")
            visit.upload("Open landmarks …", folder / "pairs.csv")
            visit.wait_for("no folding")
            visit.page.locator("#pane-fixed .mode").select_option("warped")
            visit.page.wait_for_timeout(2000)  # errors of left out landmarks are found meanwhile
            found = {f"off, {way}": misplaced(visit, **values) for way, values in WAYS.items()}
            found |= dragged(visit, seconds)
            visit.context.close()
        return found
    finally:
        os.chdir(here)
        os.environ["PYTHONPATH"] = kept


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkouts", nargs="*", type=Path, default=[ROOT])
    parser.add_argument("--seconds", type=float, default=8.0)
    parser.add_argument("--repeat", type=int, default=2)
    parser.add_argument("--landmarks", type=int, default=20, choices=range(1, 26), metavar="N")
    parser.add_argument("--side", type=int, default=512)
    chosen = parser.parse_args()
    found: dict[Path, list[dict[str, float]]] = {path.resolve(): [] for path in chosen.checkouts}
    with tempfile.TemporaryDirectory() as name, browser() as chromium:
        images(Path(name), chosen.side, chosen.landmarks)
        for _ in range(chosen.repeat):
            for path, results in found.items():
                results.append(measure(path, Path(name), chosen.seconds, chromium))
    table = Table(title=f"dragging one of {chosen.landmarks} landmarks, {chosen.side} x {chosen.side} pixels")
    table.add_column("checkout")
    for name in next(iter(found.values()))[0]:
        table.add_column(name, justify="right")
    for path, results in found.items():
        for result in results:
            table.add_row(path.name, *(f"{value:.2g}" if value < 100 else f"{value:.0f}" for value in result.values()))
    Console(width=150).print(table)


if __name__ == "__main__":
    main()
