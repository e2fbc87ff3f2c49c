"""The solutions of the gallery that the site shows: solve every problem, keep values and figures.

    python docs/record.py [PROBLEM ...]

Every problem of `problems/` and `problems/published/` is built and solved; `docs/gallery/stored/NAME.json` holds what
came out beside what is known of it (`tests/gallery_references.py`, `tests/published_references.py`), and `NAME.png` the
figure. A problem whose record belongs to its file as it is now is left alone, unless it is named. The site is made from
these, since building all modules takes most of an hour; `docs/pages.py` refuses records that do not fit their files,
and values that miss their references.
"""

from __future__ import annotations

import os

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import argparse
import json
import sys
import tempfile
from datetime import date
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from PIL import Image
from references import STORED, Known, digest, known_of, problem_files

import codegen
from codegen.machine import machine

WIDTH, COLOURS = 900, 32
"""Pixels across a figure, and how many colours it has."""


def recorded(path: Path) -> dict[str, Any]:
    """Solve a problem with its defaults and in every case of which something is known; write its figure."""
    plain = codegen.solve(path, repeat=3)
    with tempfile.TemporaryDirectory() as folder:
        whole = Path(folder) / "figure.png"
        plain.plot(whole)
        with Image.open(whole) as image:
            size = WIDTH, round(image.height * WIDTH / image.width)
            small = image.convert("RGB").resize(size, Image.Resampling.LANCZOS)
            small.quantize(COLOURS, dither=Image.Dither.NONE).save(STORED / f"{path.stem}.png", optimize=True)
    return {
        "digest": digest(path),
        "version": codegen.__version__,
        "date": date.today().isoformat(),
        "machine": {key: machine()[key] for key in ("processor", "processors", "numba", "numpy", "scipy", "python")},
        "solution": outcome(plain),
        "size": size,
        "cases": [{**outcome(solved(path, known)), "of": known.title} for known in known_of(path.stem)],
    }


def solved(path: Path, known: Known) -> Any:
    """The result in a case of which something is known."""
    return codegen.solve(path, arguments=dict(known.arguments), scheme=known.scheme, steps=known.steps, repeat=3)


def outcome(result: Any) -> dict[str, Any]:
    """The numbers of a result that the page shows."""
    return {
        "status": result.status,
        "method": result.method,
        "scheme": result.scheme,
        "intervals": result.intervals,
        "cost": result.cost,
        "iterations": result.iterations,
        "residual": result.residual,
        "seconds": result.seconds_solve,
        "summary": {name: float(value) for name, value in result.summary.items()},
    }


def main() -> None:
    """Record the problems that are named, or all that have changed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("problems", nargs="*", metavar="PROBLEM", help="names, all that have changed by default")
    named = parser.parse_args().problems
    STORED.mkdir(parents=True, exist_ok=True)
    for path in problem_files():
        record = STORED / f"{path.stem}.json"
        is_fresh = record.exists() and json.loads(record.read_text(encoding="utf-8"))["digest"] == digest(path)
        if path.stem not in named and (named or is_fresh):
            continue
        print(path.stem, flush=True)
        record.write_text(json.dumps(recorded(path), indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
