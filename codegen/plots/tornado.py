"""Which quantities the cost of a solution follows most: a bar for each, the longest on top, from its sensitivities."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.ticker import MaxNLocator

from codegen.interfaces import Vector
from codegen.plots.purposes import letter_size
from codegen.plots.style import AMBER, BLUE, DARK, quantity
from codegen.solutions.derivatives import Sensitivities

PART = 0.01
"""By what part of its value each quantity grows and shrinks."""
MOST = 8
"""Quantities with a bar."""


def changes(found: Sensitivities, values: Mapping[str, Vector]) -> dict[str, float]:
    """By how much the cost changes, to first order, as each quantity grows by one percent; the largest changes first.

    `values` (bodies,) are those of quantities. What is zero has no percent, and what differs from body to body has
    several: both are left out.
    """
    if found.reason:
        return {}
    single = {name: float(own[0]) for name, own in values.items() if own[0] != 0.0 and np.all(own == own[0])}
    every = {
        name: float(cost) * PART * abs(single[name]) for name, cost in zip(found.names, found.costs) if name in single
    }
    moving = {name: change for name, change in every.items() if change != 0.0 and np.isfinite(change)}
    return dict(sorted(moving.items(), key=lambda pair: -abs(pair[1])))


def tornado(axes: Any, shown: Mapping[str, float]) -> None:
    """Bars of the changes to both sides, where quantities grow and where they shrink by one percent."""
    names = list(shown)[:MOST]
    places = np.arange(len(names))
    sizes = np.array([shown[name] for name in names])
    for sign, colour, word in ((1.0, BLUE, "1 % more"), (-1.0, AMBER, "1 % less")):
        axes.barh(places, sign * sizes, 0.72, color=colour, alpha=0.85, label=word)
    axes.axvline(0.0, color=DARK, linewidth=0.8)
    axes.set_yticks(places, [quantity(name) for name in names])
    axes.set_ylim(len(names) - 0.4, -0.6)
    axes.tick_params(axis="y", length=0)
    axes.grid(visible=False, axis="y")
    axes.xaxis.set_major_locator(MaxNLocator(5, symmetric=True))
    axes.margins(x=0.08)
    rest = len(shown) - len(names)
    axes.set_xlabel("change of the cost" + (f"; {rest} smaller not shown" if rest else ""))
    # Above the panel, where no bar can be.
    axes.legend(
        loc="lower right",
        bbox_to_anchor=(1.0, 0.97),
        ncols=2,
        fontsize=letter_size(8),
        columnspacing=1.0,
        handlelength=1.2,
    )
