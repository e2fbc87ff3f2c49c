"""What a figure shows, as a text: for readers who do not see it, and for those who search."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
from matplotlib.figure import Figure

_MOST_PANELS = 16


def words_of(figure: Figure) -> str:
    """The title of a figure, and what each of its panels shows, from where to where."""
    title = _plain(str(figure.get_label()) or " ".join(figure.get_suptitle().split()))
    panels = list(dict.fromkeys(text for axes in figure.axes if (text := _panel(axes))))
    shown = "; ".join(panels[:_MOST_PANELS])
    more = f"; and {len(panels) - _MOST_PANELS} more" if len(panels) > _MOST_PANELS else ""
    return ". ".join(part for part in (title, f"Shown: {shown}{more}" if shown else "") if part) + "."


def _panel(axes: Any) -> str:
    """A panel's quantity with its range and what it is drawn over; a drawing by its title and legend."""
    name, over = _plain(axes.get_ylabel()), _plain(axes.get_xlabel())
    titles = [_plain(axes.get_title(loc=side)) for side in ("left", "center", "right")]
    if not name and not over:
        what = ", ".join([*filter(None, titles), *_entries(axes)])
        return f"a drawing of the system{f' ({what})' if what else ''}" if axes.has_data() or axes.artists else what
    low, high = _range(axes)
    words = [name or next(filter(None, titles), "") or ", ".join(_entries(axes))]
    words += [f"from {low:.3g} to {high:.3g}"] if low <= high and name else []
    words += [f"over {over}"] if over and not over.startswith("time") else []
    words += [f"({titles[2]})"] if titles[2] else []
    return " ".join(filter(None, words))


def _entries(axes: Any) -> list[str]:
    """The entries of a panel's legend."""
    legend = axes.get_legend() or next(iter(axes.figure.legends), None)
    return [_plain(text.get_text()) for text in legend.get_texts()] if legend is not None else []


def _range(axes: Any) -> tuple[float, float]:
    """The least and the greatest value of all curves of a panel that have more than two points."""
    tables = [np.asarray(line.get_ydata(), dtype=float) for line in axes.lines if np.size(line.get_ydata()) > 2]
    tables += [np.asarray(step.get_data().values, dtype=float) for step in axes.patches if hasattr(step, "get_data")]
    values = np.concatenate([np.zeros(0), *(table.ravel() for table in tables)])
    finite = values[np.isfinite(values)]
    return (float(finite.min()), float(finite.max())) if finite.size else (1.0, 0.0)


def _plain(text: str) -> str:
    r"""Words for mathematics: $\dot{\theta}_{1}$ is `rate of theta_1`."""
    text = re.sub(r"\\dot\{((?:[^{}]|\{[^{}]*\})*)\}", r"rate of \1", text)
    text = re.sub(r"\\mathrm\{([^{}]*)\}", r"\1", text)
    text = re.sub(r"\\var(?=phi|epsilon)", "", text)
    return re.sub(r"[${}\\]", "", text).strip()
