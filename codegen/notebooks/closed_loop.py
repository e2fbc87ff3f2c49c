"""A closed loop in a notebook: a table of how its sampling times ended, with its figure."""

from __future__ import annotations

from typing import Any

from codegen.notebooks.tables import number, table
from codegen.plots.closed_loop import References, closed_loop_figure
from codegen.plots.picture import Picture
from codegen.plots.purposes import finished, using


def html(loop: Any) -> str:
    """How the sampling times ended, how long they took, and the figure."""
    ended = ", ".join(f"{count} {status}" for status, count in loop.counts.items())
    times = f"median {number(1e3 * loop.latency(50), 3)} ms, 99.9 % below {number(1e3 * loop.latency(99.9), 3)} ms"
    rows = [
        ("sampling times", f"{loop.latencies.size}, every {number(loop.sample)}"),
        ("status", ended or "none"),
        *([("ended early", loop.message)] if loop.message else []),
        ("fell back", str(int(loop.fell_back.sum()))),
        ("latency", times),
        *([("deadlines missed", str(loop.missed))] if loop.deadline is not None else []),
    ]
    own = table(rows, caption=loop.title)
    return own + picture(loop, {})._repr_html_() if loop.latencies.size else own


def picture(loop: Any, references: References) -> Picture:
    """The figure of states, inputs and latencies, with what they were to follow."""
    with using("page"):
        return Picture(finished(closed_loop_figure(loop, references)))
