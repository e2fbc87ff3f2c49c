"""The record of one registration in words and numbers, for terminals and pages."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping
from typing import Any

from codegen.registration.grid import short
from codegen.registration.jobs import MOST_LEFT_OUT


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
