"""Titles of figures, labels of axes and units."""

from __future__ import annotations

import json
import re
import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from codegen import identifiers
from codegen.show.figures.picture import STYLES, letter_size, present_style
from codegen.solving.results.result import Result

if TYPE_CHECKING:
    from xarray import Dataset

_SIGNS = (("**", "^"), ("<=", "≤"), (">=", "≥"), ("*", "·"))


def label(name: str) -> str:
    """Return a symbol's name as LaTeX between $ signs; phi1 becomes a Greek letter with an index."""

    def letter(part: str) -> str:
        rest = part[1:]
        if part.startswith("d") and rest and not rest.isdigit() and not identifiers.word(rest).startswith(r"\mathrm"):
            return rf"\dot{{{identifiers.word(rest)}}}"
        return identifiers.word(part)

    if name.startswith("|"):  # a length
        return f"|{label(name.strip('|'))}|"
    parts = re.sub(r"(?<=[A-Za-z])(\d+)$", r"_\1", name).split("_")
    letters = [letter(part) for part in parts if part] or [identifiers.word(name)]
    return "$" + letters[0] + ("_{" + ",".join(letters[1:]) + "}" if len(letters) > 1 else "") + "$"


def relation(text: str, longest: int = 46) -> str:
    """Return the text of a relation with mathematical signs, cut to at most `longest` characters."""
    for sign, better in _SIGNS:
        text = text.replace(sign, better)
    return text if len(text) <= longest else text[: longest - 1] + "…"


def title(figure: Figure, result: Result, notes: Sequence[str] = ()) -> None:
    """Set the title of a result's figure: problem, discretisation, outcome and notes."""
    outcome = [f"{result.method}, {result.scheme}, {result.intervals}"]
    outcome += [f"cost {result.cost:.6g}"] if result.cost is not None else []
    outcome += [] if result.solved else [f"NOT SOLVED: {result.status}"]
    set_title(figure, result.title, [*outcome, *notes], is_needed=not result.solved)


def set_title(figure: Figure, name: str, details: Sequence[str], is_needed: bool = False) -> None:
    """Set the figure's label, which descriptions use, and its title if the style has titles or `is_needed`."""
    texts = name.rstrip("."), ", ".join(details)
    figure.set_label(". ".join(texts))
    if present_style().has_title or is_needed:
        # Number of letters on a line.
        letters = int(10.0 * figure.get_figwidth() * STYLES["page"].letters / present_style().letters)
        lines = (line for text in texts for line in textwrap.wrap(text, letters))
        figure.suptitle("\n".join(lines), fontsize=letter_size(11))


def quantity(name: str, data: Dataset | None = None) -> str:
    """Return the label of a varied quantity, such as a parameter or `start.r`, the prescribed value of r at the start.

    The label ends with the unit, if a sweep's `data` contain the unit.
    """
    end, dot, own = name.partition(".")
    text = f"{label(own)} at the {end}" if dot else label(name)
    return in_unit(text, unit_in(data, name) if data is not None else "")


def unit_in(data: Dataset, name: str) -> str:
    """Return the unit in a sweep's data of a quantity such as `m`, `start.r`, `cost`, `t` or `duration`, or ""."""
    own = name.rpartition(".")[2]
    return str(json.loads(data.attrs.get("units", "{}")).get("t" if own == "duration" else own, ""))


def statuses(data: Dataset) -> NDArray[np.str_]:
    """Return the status of each case of a sweep as text, whatever text type the file has."""
    values = data["status"].values
    return np.array(values.ravel().tolist(), dtype=np.str_).reshape(values.shape)


def heading(figure: Figure, data: Dataset, where: str = "") -> None:
    """Set the title of a sweep: problem, discretisation, failed cases, and the text `where` on the drawn cases."""
    own = data.attrs
    steps = [f"{own['steps']} steps"] if "steps" in own else []
    status = statuses(data)
    failed = int((status != "solved").sum())
    outcome = f"{status.size} cases" + (f", {failed} FAILED" if failed else "")
    details = [own["formulation"], own["scheme"], *steps, outcome + where]
    set_title(figure, str(own["title"]), details, is_needed=failed > 0)


def in_unit(text: str, unit: str) -> str:
    """Return the label of an axis with the unit, unless the unit is empty."""
    return f"{text} ({unit})" if unit else text
