"""One page about one pair: pictures, certificate and landmarks, in an HTML file that needs no other."""

from __future__ import annotations

import math
import platform
import statistics
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import jinja2
import numpy as np

from codegen import __version__
from codegen.files import replacing
from codegen.registration import pair_pictures as pictures
from codegen.registration.grid import short
from codegen.registration.jobs import MOST_LEFT_OUT, Outcome, Result
from codegen.registration.pair_pictures import Picture


def rows(record: Mapping[str, Any]) -> list[tuple[str, str]]:
    """What was found, in words and numbers; distances in pixels, and in the unit that a picture carries."""
    seen = record["summary"]
    found = [("landmarks", str(seen["landmarks"]))]
    if "det_min" not in seen:
        return found
    unit = short(seen.get("unit", "pixels"))
    sigma = f", sigma {record['sigma']:.3g} {unit}" if record["sigma"] or seen["sigma_chosen"] else ""
    sigma += " by likelihood" if seen["sigma_chosen"] else ""
    found += [
        (name, seen[key]) for name, key in (("alignment", "alignment_choice"), ("sigma", "sigma_message"))
        if seen.get(key)
    ]  # fmt: skip
    place = ", ".join(f"{x:g}" for x in seen["det_min_at"])
    found += [
        ("method", f"{record['align']} alignment, {record['scheme']}, {record['steps']} steps{sigma}"),
        ("residual", _residual(record, unit)),
        ("det J", f"{number(seen['det_min'])} at ({place}) to {number(seen['det_max'])}"),
        (
            "folded",
            "nowhere, which is proved"
            if seen["proved"]
            else f"{seen['folded']} {'pixels' if len(seen['det_min_at']) == 2 else 'voxels'}",
        ),
        ("round trip", f"{number(seen['round_trip'])} {unit}"),
    ]
    if seen["scheme_error"] is not None:
        found.append(("error of the scheme", f"{number(seen['scheme_error'])} {unit}"))
    if seen.get("leave_one_out"):
        text = f"{_median(seen['leave_one_out'])} {unit} (median)"
        if "length_unit" in seen:
            text += f", {_median(seen['leave_one_out_lengths'])} {seen['length_unit']}"
        found.append(("leave one out", text))
    elif seen["landmarks"] > MOST_LEFT_OUT:
        found.append(("leave one out", f"not done for more than {MOST_LEFT_OUT} landmarks"))
    found.append(("outliers", ", ".join(seen["outliers"]) or "none"))
    if seen.get("spacing", 1) != 1:
        text = f"every {seen['spacing']} pixels, error below {number(seen['spacing_bound'])} {unit}"
        if not isinstance(seen["spacing"], int):
            steps = " x ".join(map(str, seen["spacing"]))
            exact = f"{seen['exact']:.0%} of the voxels exactly"
            text = f"every {steps} voxels, error below {number(seen['spacing_bound'])} {unit}; {exact}"
        found.append(("grid", text))
    return found


def _residual(record: Mapping[str, Any], unit: str) -> str:
    seen = record["summary"]
    text = f"{number(record['residual'])} {unit} at most, standard deviation {number(seen['deviation'])} {unit}"
    if "length_unit" not in seen:
        return text
    largest, deviation = number(max(seen["residual_lengths"])), number(seen["deviation_length"])
    return f"{text} ({largest} and {deviation} {seen['length_unit']})"


def _median(errors: list[float | None]) -> str:
    finite = [error for error in errors if error is not None]
    return number(statistics.median(finite)) if finite else "–"


def number(value: float | None) -> str:
    """A number in few characters."""
    return "–" if value is None or not math.isfinite(value) else f"{value:.4g}"


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
    # The files, by their names alone: a page may travel.
    names = [f"moving: {Path(record['moving']).name}"]
    names += [f"fixed: {Path(record['fixed']).name}"] if record["fixed"] else []
    names.append("landmarks: " + " and ".join(Path(name).name for name in record["landmarks"]))
    if record["status"] == "solved":
        names.append(f"written to: {Path(record['out']).name}")
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
    return template.render(
        title=f"{Path(record['moving']).name}, {record['direction']}", subtitle=", ".join(names),
        passed=result.passed, status=record["status"], message=_sentence(record["message"]), facts=rows(record),
        pictures=shown, columns=columns(result.pairs.dimension, record["summary"].get("length_unit", "")),
        rows=made, note=note,
        environment=_environment(record),
    )  # fmt: skip


def columns(dimension: int, unit: str = "") -> tuple[str, ...]:
    """The headings of the table of landmarks; errors have more columns in the unit that a picture carries."""
    places = [f"{image} {axis}" for image in ("moving", "fixed") for axis in "xyz"[:dimension]]
    lengths = (f"residual, {unit}", f"left out, {unit}") if unit else ()
    return ("landmark", *places, "residual", "left out", *lengths, "")


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:] + "." if text else ""


def _environment(record: dict[str, Any]) -> str:
    versions = ", ".join(f"{name} {metadata.version(name)}" for name in ("numpy", "scipy", "numba"))
    seconds = ", ".join(f"{name} {value:.3g} s" for name, value in record["seconds"].items())
    return f"codegen {__version__}, Python {platform.python_version()}, {versions}. {seconds}."
