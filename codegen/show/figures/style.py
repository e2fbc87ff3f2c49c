"""What all pictures share: colours, symbols as mathematics, titles."""

from __future__ import annotations

import json
import re
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from codegen import identifiers
from codegen.show.figures.picture import letter_size, letters_across
from codegen.solving.results.result import Result

if TYPE_CHECKING:
    from xarray import Dataset


BLUE, RED, GREEN, PINK, AMBER, SKY = "#0072B2", "#D55E00", "#009E73", "#B8578F", "#E69F00", "#56B4E9"
"""Colours that remain distinct for colour-blind readers: Okabe and Ito (2008), Color universal design."""
GREY, DARK = "#707070", "#303030"
CRIMSON = "#BE1E2D"
"""Arrows."""
FORBIDDEN = "#F6DFD3"
"""The side of a bound that must not be entered."""

MOST_BODY_COLOURS = 7
"""As many bodies have colours of their own; more are graded."""

_SIGNS = (("**", "^"), ("<=", "≤"), (">=", "≥"), ("*", "·"))


def body_colours(bodies: int, single: str) -> list[Any]:
    """A colour for every body; that of a `single` one is given."""
    if bodies == 1:
        return [single]
    if bodies <= MOST_BODY_COLOURS:
        return [BLUE, GREEN, PINK, AMBER, SKY, DARK, GREY][:bodies]
    return [body_map()(index / (bodies - 1)) for index in range(bodies)]


def body_map() -> Any:
    """The colour map along which many bodies are graded; its palest end is left out."""
    whole = matplotlib.colormaps["viridis"]
    return matplotlib.colors.ListedColormap(whole([0.92 * i / 255 for i in range(256)]))


def label(name: str) -> str:
    """A symbol's name as mathematics: phi1 becomes a Greek letter with an index."""
    parts = re.sub(r"(?<=[A-Za-z])(\d+)$", r"_\1", name).split("_")
    letters = [_letter(part) for part in parts if part] or [identifiers.word(name)]
    return "$" + letters[0] + ("_{" + ",".join(letters[1:]) + "}" if len(letters) > 1 else "") + "$"


def _letter(name: str) -> str:
    rest = name[1:]
    if name.startswith("d") and rest and not rest.isdigit() and not identifiers.word(rest).startswith(r"\mathrm"):
        return rf"\dot{{{identifiers.word(rest)}}}"
    return identifiers.word(name)


def relation(text: str, longest: int = 46) -> str:
    """A relation as its author wrote it, with the signs of mathematics, no longer than that many characters."""
    for sign, better in _SIGNS:
        text = text.replace(sign, better)
    return text if len(text) <= longest else text[: longest - 1] + "…"


def title(figure: Figure, result: Result, notes: Sequence[str] = ()) -> None:
    """What was solved, how, and with what outcome; `notes` come last."""
    outcome = [f"{result.method}, {result.scheme}, {result.intervals}"]
    outcome += [f"cost {result.cost:.6g}"] if result.cost is not None else []
    outcome += [] if result.solved else [f"NOT SOLVED: {result.status}"]
    letters = letters_across(figure)
    texts = result.title.rstrip("."), ", ".join([*outcome, *notes])
    figure.set_label(". ".join(texts))
    figure.suptitle(
        "\n".join(line for text in texts for line in textwrap.wrap(text, letters)), fontsize=letter_size(11)
    )


def quantity(name: str, data: Dataset | None = None) -> str:
    """What a varied quantity is called; prescribed values have the end and the name, as in `start.r`.

    The units of a sweep's `data` stand behind it, where its author gave them.
    """
    end, dot, own = name.partition(".")
    text = f"{label(own)} at the {end}" if dot else label(name)
    unit = json.loads(data.attrs.get("units", "{}")).get(own or name, "") if data is not None else ""
    return f"{text} ({unit})" if unit else text


def statuses(data: Dataset) -> NDArray[np.str_]:
    """The status of each case of a sweep, of whatever type of words a file has them."""
    values = data["status"].values
    return np.array(values.ravel().tolist(), dtype=np.str_).reshape(values.shape)


def heading(figure: Figure, data: Dataset, where: str = "") -> None:
    """What a sweep has solved, how, how many of its cases failed, and `where` those lie that are drawn."""
    own = data.attrs
    steps = [f"{own['steps']} steps"] if "steps" in own else []
    status = statuses(data)
    failed = int((status != "solved").sum())
    outcome = f"{status.size} cases" + (f", {failed} FAILED" if failed else "")
    letters = letters_across(figure)
    texts = str(own["title"]).rstrip("."), ", ".join([own["formulation"], own["scheme"], *steps, outcome]) + where
    figure.set_label(". ".join(texts))
    figure.suptitle(
        "\n".join(line for text in texts for line in textwrap.wrap(text, letters)), fontsize=letter_size(11)
    )


@dataclass(frozen=True)
class Units:
    """Units by names of quantities, as texts; `t` is the time, `energy` the energy. What is missing has none."""

    by_name: Mapping[str, str]

    @classmethod
    def of(cls, result: Result, time: str = "") -> Units:
        """Those of a result; `time` is what else is known of the unit of the time."""
        return cls({**({"t": time} if time else {}), **result.units})

    @property
    def time(self) -> str:
        """The label of an axis of time."""
        return self.named("time", "t")

    def label(self, name: str) -> str:
        """The label of an axis of a quantity."""
        return self.named(label(name), name)

    def named(self, text: str, name: str) -> str:
        """A text for a quantity, with its unit."""
        unit = self.by_name.get(name, "")
        return f"{text} ({unit})" if unit else text
