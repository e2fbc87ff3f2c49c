"""One page about one pair: pictures, certificate and landmarks, in an HTML file that needs no other."""

from __future__ import annotations

import platform
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import jinja2
import numpy as np

from codegen import __version__
from codegen.files import replacing
from codegen.registration import pair_pictures as pictures
from codegen.registration.jobs import Outcome, Result
from codegen.registration.pair_pictures import Picture
from codegen.registration.record_text import number, rows

RESIDUALS = (
    "Residual: how far a moving landmark arrives from the fixed one. Left out: how far it would arrive if the other "
    "landmarks alone made the map."
)
NOTE = f"Places and errors are in pixels, x to the right and y down from the centre of the top-left pixel. {RESIDUALS}"
MOST_ROWS = 2_000
"""Landmarks beyond are left out of the table, which says so."""


@dataclass(frozen=True)
class Row:
    """The cells of a landmark, and whether it stands out."""

    cells: tuple[str, ...]
    outlier: bool


def write_report(path: Path, result: Result) -> None:
    """Write the page; FileError where the file system refuses."""
    write_page(path, result, pictures.of(result), NOTE)


def write_page(path: Path, result: Outcome, shown: list[Picture], note: str) -> None:
    """Write a page with pictures, and a note about its numbers; FileError where the file system refuses."""
    text = render(result, shown, note)
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def render(result: Outcome, shown: list[Picture], note: str) -> str:
    """The text of the page, of a registration that succeeded or failed."""
    loader = jinja2.FileSystemLoader(Path(__file__).parent / "templates")
    template = jinja2.Environment(
        loader=loader, autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    ).get_template("pair.html.j2")
    record = result.record
    return template.render(
        title=f"{Path(record['moving']).name}, {record['direction']}", subtitle=_subtitle(record),
        passed=result.passed, status=record["status"], message=_sentence(record["message"]), facts=rows(record),
        pictures=shown, columns=columns(result.pairs.dimension, record["summary"].get("length_unit", "")),
        rows=_rows(result), note=note,
        environment=_environment(record),
    )  # fmt: skip


def columns(dimension: int, unit: str = "") -> tuple[str, ...]:
    """The headings of the table of landmarks; errors have more columns in the unit that a picture carries."""
    places = [f"{image} {axis}" for image in ("moving", "fixed") for axis in "xyz"[:dimension]]
    lengths = (f"residual, {unit}", f"left out, {unit}") if unit else ()
    return ("landmark", *places, "residual", "left out", *lengths, "")


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:] + "." if text else ""


def _subtitle(record: dict[str, Any]) -> str:
    """The files, by their names alone: a page may travel."""
    names = [f"moving: {Path(record['moving']).name}"]
    names += [f"fixed: {Path(record['fixed']).name}"] if record["fixed"] else []
    names.append("landmarks: " + " and ".join(Path(name).name for name in record["landmarks"]))
    if record["status"] == "solved":
        names.append(f"written to: {Path(record['out']).name}")
    return ", ".join(names)


def _rows(result: Outcome) -> list[Row]:
    pairs = result.pairs
    residuals = result.registration.residuals if result.registration is not None else np.full(len(pairs), np.nan)
    left_out = result.left_out.errors if result.left_out is not None else np.full(len(pairs), np.nan)
    errors = [residuals, left_out]
    seen, outliers = result.record["summary"], set(result.out_of_place)
    if "length_unit" in seen:
        unknown = [None] * len(pairs)
        errors += [seen["residual_lengths"], seen.get("leave_one_out_lengths", unknown)]
    made = []
    for k in range(min(len(pairs), MOST_ROWS)):
        places = [f"{value:.2f}" for value in (*pairs.moving[k], *pairs.fixed[k])]
        cells = (pairs.names[k], *places, *(number(of[k]) for of in errors), "outlier" if k in outliers else "")
        made.append(Row(cells, k in outliers))
    if len(pairs) > MOST_ROWS:
        made.append(Row((f"and {len(pairs) - MOST_ROWS} more", *[""] * (len(made[0].cells) - 1)), False))
    return made


def _environment(record: dict[str, Any]) -> str:
    versions = ", ".join(f"{name} {metadata.version(name)}" for name in ("numpy", "scipy", "numba"))
    seconds = ", ".join(f"{name} {value:.3g} s" for name, value in record["seconds"].items())
    return f"codegen {__version__}, Python {platform.python_version()}, {versions}. {seconds}."
