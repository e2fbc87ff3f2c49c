"""Figures 3.1 and 3.2 of the thesis: the linearised pendulum by three transcriptions, beside the exact optimum."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from codegen.interfaces import is_control
from codegen.plots.style import BLUE, DARK, GREEN, RED
from codegen.report.building import SURVEYS, Variant, Workshop
from codegen.report.extent import Extent
from codegen.report.figures.landmarks import svg
from codegen.report.measure.optima import solved
from codegen.report.measure.orders import measured_order, order_text
from codegen.report.section import Picture, Section, Table, number, seconds
from codegen.report.store import Case, Store, Values

SECTION = "linear_pendulum: figures 3.1 and 3.2"
STEPS = tuple(range(10, 201, 5))
METHODS = (
    ("Var.", "variational", "midpoint", 2, BLUE, "-"),
    ("Euler", "hamiltonian", "explicit-euler", 1, RED, "-"),
    ("Ham. Eq'ns", "hamiltonian", "midpoint", 2, GREEN, "--"),
)
"""The thesis's name, method, scheme, order, and how it is drawn."""


def variants(problem: Path) -> list[Variant]:
    """The modules of the three transcriptions."""
    return [Variant(problem, method, scheme, order) for _, method, scheme, order, _, _ in METHODS]


def cases(problem: Path, workshop: Workshop, extent: Extent) -> Iterator[Case]:
    """N = 10:5:200 for each transcription, every fourth of these in the quick form."""
    for variant, (label, *_) in zip(variants(problem), METHODS, strict=True):
        for steps in STEPS[::4] if extent.quick else STEPS:
            yield Case(
                SECTION,
                f"{label}; N {steps}",
                lambda v=variant, n=steps: _solved(workshop, v, n, extent.repeat),  # type: ignore[misc]
            )


def _solved(workshop: Workshop, variant: Variant, steps: int, repeat: int) -> Values:
    module = workshop.module(variant)
    assert is_control(module)
    return solved(module, steps, repeat)


def _rows(store: Store, label: str) -> list[Values]:
    return [values for name, values in store.rows(SECTION) if name.startswith(f"{label}; ")]


def sections(store: Store, problem: Path) -> list[Section]:
    """Cost, error and time against the number of steps."""
    exact = (store.get(SURVEYS, problem.stem) or {}).get("exact cost")
    if exact is None or not _rows(store, "Var."):
        return []
    rows = []
    for label, method, scheme, order, *_ in METHODS:
        values = _rows(store, label)
        wrong = [abs(v["cost"] - exact) for v in values]
        rows.append((
            label, f"{method} {scheme}", str(order),
            order_text(measured_order([v["steps"] for v in values], wrong), order),
            number(wrong[0], 2), number(wrong[-1], 2), seconds(values[0]["seconds"]), seconds(values[-1]["seconds"]),
            str(sum(v["status"] != "solved" for v in values)),
        ))  # fmt: skip
    first, last = _rows(store, "Var.")[0]["steps"], _rows(store, "Var.")[-1]["steps"]
    head = ("thesis", "here", "stated order", "measured", f"error at N = {first}", f"at N = {last}",
            f"time at N = {first}", f"at N = {last}", "failed")  # fmt: skip
    text = (
        f"The exact cost, {exact:.15g}, is the closed form that is derived from the problem file. Controls live on "
        "intervals here; the thesis has them on nodes, so that its curves differ in the constant."
    )
    table = Table("The transcriptions of section 3.2.", head, tuple(rows))
    picture = Picture("Cost, its error, and time of one solve against the number of steps N = 10:5:200.",
                      svg(lambda: figure(store, exact)))  # fmt: skip
    return [Section("Linearised pendulum: Figures 3.1 and 3.2", (text,), (table,), (picture,))]


def figure(store: Store, exact: float) -> Figure:
    """Three panels."""
    drawn = Figure(figsize=(9.6, 3.3), layout="constrained")
    costs, errors, times = drawn.subplots(1, 3)
    for label, _, _, _, colour, style in METHODS:
        rows = _rows(store, label)
        steps = [v["steps"] for v in rows]
        look: dict[str, Any] = {"color": colour, "linestyle": style}
        costs.plot(steps, [v["cost"] for v in rows], label=label, **look)
        errors.loglog(steps, [abs(v["cost"] - exact) for v in rows], **look)
        times.plot(steps, [1e3 * v["seconds"] for v in rows], **look)
    costs.axhline(exact, color=DARK, linewidth=0.9, linestyle=":", label="Exact")
    costs.set(ylabel="cost", xlabel="steps $N$")
    errors.set(ylabel="|cost − exact|", xlabel="steps $N$", xticks=[10, 20, 50, 100, 200],
               xticklabels=["10", "20", "50", "100", "200"])  # fmt: skip
    errors.minorticks_off()
    times.set(ylabel="time [ms]", xlabel="steps $N$")
    times.set_ylim(bottom=0.0)
    costs.legend(loc="best")
    return drawn
