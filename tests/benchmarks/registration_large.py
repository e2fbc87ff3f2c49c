"""Large images and first use of registration, by the command in a process of its own; a part of registration.py."""

import json
import os
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import Any

import numpy as np
from particles import TRILOBITES
from PIL import Image
from planar_maps import CONSOLE, in_pixels

from codegen.problem.points import read_points


def measured(command: list[str], cache: str | None = None) -> tuple[dict[str, Any], float, float, float]:
    """What a command prints as JSON, its seconds, those of processors, and its largest memory in GB."""
    environment = os.environ | ({} if cache is None else {"CODEGEN_CACHE_DIR": cache})
    begin = perf_counter()
    with subprocess.Popen(command, stdout=subprocess.PIPE, env=environment) as process:
        printed = process.stdout.read() if process.stdout else b""
        used = os.wait4(process.pid, 0)[2]
        process.returncode = 0
    lines = printed.decode().strip()
    return (
        json.loads(lines) if lines else {},
        perf_counter() - begin,
        used.ru_utime + used.ru_stime,
        used.ru_maxrss / 2**20,
    )


def _command(folder: Path, width: int, height: int) -> list[str]:
    """Files of an image with 40 landmarks, and the command that warps it."""
    x, y = np.arange(width), np.arange(height)[:, None]
    picture = (127 + 60 * np.sin(x / 37) + 60 * np.sin(y / 51)).astype(np.uint8)
    Image.fromarray(picture).save(folder / "a.png", compress_level=1)
    pairs = in_pixels(read_points(TRILOBITES, 2), min(width, height))
    table = np.hstack([pairs.moving, pairs.fixed])
    np.savetxt(folder / "a.csv", table, delimiter=",", header="moving_x,moving_y,fixed_x,fixed_y", comments="")
    files = [str(folder / "a.png"), "--landmarks", str(folder / "a.csv"), "--out", str(folder / "b.png")]
    return [sys.executable, "-m", "codegen", "warp", *files, "--json"]


SPLINE = """
import sys, numpy as np
from skimage.transform import ThinPlateSplineTransform, warp
table = np.loadtxt(sys.argv[1], delimiter=",", skiprows=1)
width, height, scale = (float(word) for word in sys.argv[2:])
picture = np.zeros((int(height), int(width)), np.uint8)
spline = ThinPlateSplineTransform.from_estimate(table[:, 2:] * scale, table[:, :2] * scale)
warp(picture, spline, order=1, preserve_range=True)
"""


def large(count: int, repeat: int) -> None:
    """8000 x 6000 pixels and 40 landmarks by the command, and scikit-image's thin-plate spline on fewer pixels."""
    del count, repeat
    with TemporaryDirectory() as name:
        folder = Path(name)
        command = _command(folder, 8000, 6000)
        for option in ((), ("--exact",)):
            record, wall, used, memory = measured([*command, *option])
            parts = {part: round(seconds, 1) for part, seconds in record["seconds"].items()}
            share, seen = (
                record["seconds"]["certify"] / wall,
                f"{wall:.1f} s ({used:.1f} s of processors), {memory:.2f} GB",
            )
            CONSOLE.print(f"8000 x 6000 {' '.join(option)}: {seen}, "
                          f"certificate {share:.0%}; {record['status']}, {parts}")  # fmt: skip
        for width, height in ((1000, 750), (2000, 1500)):
            scale = str(width / 8000)
            spline = [sys.executable, "-c", SPLINE, str(folder / "a.csv"), str(width), str(height), scale]
            _, wall, used, memory = measured(spline)
            CONSOLE.print(
                f"scikit-image, {width} x {height}: {wall:.1f} s ({used:.1f} s of processors), {memory:.2f} GB"
            )


def first(count: int, repeat: int) -> None:
    """The first run on a machine, in which the solver is derived and compiled, and the second."""
    del count, repeat
    with TemporaryDirectory() as name:
        command = _command(Path(name), 512, 512)
        for run in ("first", "second"):
            record, wall, used, _ = measured(command, cache=str(Path(name) / "cache"))
            build = record["seconds"]["build"]
            CONSOLE.print(f"{run} run: {wall:.1f} s ({used:.1f} s of processors), of which solver {build:.1f} s")
