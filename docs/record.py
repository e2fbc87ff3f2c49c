"""The solutions of the gallery that the site shows: solve every problem, keep values and figures.

    python docs/record.py [PROBLEM ...]

Every problem of `problems/` and `problems/published/` is built and solved; `docs/gallery/stored/NAME.json` holds what
came out beside what is known of it (`tests/gallery_references.py`, `tests/published_references.py`), `NAME.png` the
figure, `NAME.gif` the film where the problem has a drawing, and `NAME.still.png` its last frame. A problem whose record
belongs to its file as it is now is left alone, unless it is named or lacks its film. The site is made from these, since
building all modules takes most of an hour; `docs/_extensions/pages.py` refuses records that do not fit their files, and
values that miss their references.
"""

from __future__ import annotations

import os

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import argparse
import io
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
from codegen.drawing import Item
from codegen.machine import machine
from codegen.problem.sources import ProblemFile
from codegen.show.figures import shapes

WIDTH, COLOURS = 900, 64
"""Pixels across a figure, and how many colours it has."""
FILM_WIDTH, FILM_COLOURS, EVERY = 420, 24, 2
"""The same of a film, and which of its frames are kept."""


def recorded(path: Path) -> dict[str, Any]:
    """Solve a problem with its defaults and in every case of which something is known; write its figure and film."""
    plain = codegen.solve(path, repeat=3)
    size, text = drawn(path, plain)
    return {
        "digest": digest(path),
        "version": codegen.__version__,
        "date": date.today().isoformat(),
        "machine": {key: machine()[key] for key in ("processor", "processors", "numba", "numpy", "scipy", "python")},
        "solution": outcome(plain),
        "size": size,
        "text": text,
        "film": filmed(path, plain),
        "cases": [{**outcome(solved(path, known)), "of": known.title} for known in known_of(path.stem)],
    }


def drawn(path: Path, solution: Any) -> tuple[tuple[int, int], str]:
    """Write the figure of a solution, smaller than `codegen solve --plot` does; its size, and what it shows."""
    with tempfile.TemporaryDirectory() as folder:
        whole = Path(folder) / "figure.png"
        picture = solution.plot(whole)
        with Image.open(whole) as image:
            size = WIDTH, round(image.height * WIDTH / image.width)
            small = image.convert("RGB").resize(size, Image.Resampling.LANCZOS)
            small.quantize(COLOURS, dither=Image.Dither.NONE).save(STORED / f"{path.stem}.png", optimize=True)
    return size, picture.text


def drawing_of(path: Path) -> list[Item]:
    """What a picture of a problem shows."""
    problem = ProblemFile(path).written({})[1]
    parts = problem.phases if isinstance(problem, codegen.Phases) else (problem,)
    return [item for part in parts for item in part.drawing]


def filmed(path: Path, solution: Any) -> dict[str, Any] | None:
    """Write the film of a solution, half as often as `codegen solve --animate` does, and its last frame."""
    shows = drawing_of(path)
    if not shows:
        return None
    with Image.open(io.BytesIO(solution.animate().data)) as film:
        size = FILM_WIDTH, round(film.height * FILM_WIDTH / film.width)
        kept = range((film.n_frames - 1) % EVERY, film.n_frames, EVERY)
        frames = [_frame(film, number, size) for number in kept]
    palette = frames[-1].quantize(FILM_COLOURS)
    *others, last = (frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames)
    between = EVERY * 1000 // shapes.RATE
    durations = [*[between] * len(others), round(1000 * shapes.PAUSE)]
    others[0].save(
        STORED / f"{path.stem}.gif", save_all=True, append_images=[*others[1:], last], duration=durations, loop=0,
        optimize=True,
    )  # fmt: skip
    last.save(STORED / f"{path.stem}.still.png", optimize=True)
    return {"size": size, "until": float(solution.t[-1]), "shows": words_for(shows)}


def _frame(film: Image.Image, number: int, size: tuple[int, int]) -> Image.Image:
    film.seek(number)
    return film.convert("RGB").resize(size, Image.Resampling.LANCZOS)


def words_for(shows: list[Item]) -> list[str]:
    """What a drawing shows, by its labels where it has some, each once."""
    return list(dict.fromkeys(item.label or type(item).__name__.lower() for item in shows))


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
        kept = json.loads(record.read_text(encoding="utf-8")) if record.exists() else {}
        if path.stem in named or (not named and kept.get("digest") != digest(path)):
            kept = recorded(path)
        elif not named and drawing_of(path) and not kept.get("film"):
            kept["film"] = filmed(path, codegen.solve(path))
        else:
            continue
        print(path.stem, flush=True)
        record.write_text(json.dumps(kept, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
