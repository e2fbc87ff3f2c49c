"""Sections about an optimal-control problem."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from codegen.evidence.report import optima
from codegen.evidence.report.building import Variant
from codegen.evidence.report.landmark_figures import svg
from codegen.evidence.report.optima import Convergence, case_name, convergence_of, drivers_of, errors_of, references_of
from codegen.evidence.report.orders import ABOVE_REFERENCE, SETTLED, Order, order_text
from codegen.evidence.report.page import Picture, Section, Table, listed, number, seconds, without_empty_columns
from codegen.evidence.report.problem_figures import Line, times_of_drivers, work_precision
from codegen.evidence.report.store import Store, Values

NEAR = 0.01
"""The reference's error is drawn where it is more than this part of the least error."""
OTHER_OPTIMUM = 0.1
"""Where the finest cost is off by more than this part, a remark says so."""


_ORDERS = (
    "Orders are measured in mesh sequences: each grid starts from the optimum on a coarser one, so that all follow one "
    "optimum, until the orders between successive grids agree within "
    f"{SETTLED:g} over three grids, at {ABOVE_REFERENCE:g} times the reference's error or above. A control that is "
    "constant on each interval approximates a smooth one at order 2, and the cost at its minimum no better, whatever "
    "the scheme of the motion (Hager 2000; Dontchev, Hager and Veliov 2000): the lesser of 2 and the scheme's order is "
    "expected. Superconvergent are schemes whose first error cancels in the cost, as where they differ from one of "
    "higher order by an impulse at the ends."
)
_SWITCHING = (
    "This optimum is not smooth: bounds of {names} become active or inactive within the motion. The interval in which "
    "that happens holds one mean value of the control, which moves the state by a multiple of h² that depends on the "
    "place in the interval. The same orders are expected of the size of the error (Euler's methods: Dontchev and Hager "
    "2001 for bounds of states, Alt, Baier, Gerdts and Lempio 2012 for controls that switch), but without a steady "
    "factor. So they are fitted to six grids per doubling; ± is twice the standard error of the slope."
)


def rows_of(store: Store, problem: Path, variant: Variant) -> list[Values]:
    """What was measured of a scheme, by growing number of steps."""
    rows = [v for name, v in store.rows(errors_of(problem)) if name.startswith(case_name(variant, 0)[:-1])]
    return sorted(rows, key=lambda values: values["steps"])


def errors(store: Store, problem: Path, variant: Variant) -> list[float | None]:
    """Relative errors in cost, None where a solve failed or there is no reference."""
    exact = (store.get(references_of(problem), "cost") or {}).get("cost")
    return [relative_error(values, exact) for values in rows_of(store, problem, variant)]


def relative_error(values: Values, exact: float | None) -> float | None:
    """|J - J*|/|J*|, absolute for J* = 0."""
    if exact is None or values["status"] != "solved" or values["cost"] is None:
        return None
    return float(abs(values["cost"] - exact) / (abs(exact) or 1.0))


def order_of(store: Store, problem: Path, variant: Variant) -> Order | None:
    """The measured order of a scheme, from errors of the cost."""
    return found_of(store, problem, variant).order


def verdict_of(store: Store, problem: Path, variant: Variant) -> str:
    """What is to be said of it; nothing where it is the expected one."""
    return found_of(store, problem, variant).said


def found_of(store: Store, problem: Path, variant: Variant) -> Convergence:
    """What the mesh sequence of a scheme shows."""
    return convergence_of(store, problem, variant, expected_order(store, problem, variant))


def expected_order(store: Store, problem: Path, variant: Variant) -> int:
    """The order that the cost is to have: the scheme's, but 2 at most where controls are constant on intervals."""
    known = (values.get("expected order") for values in rows_of(store, problem, variant))
    return next((int(order) for order in known if order is not None), variant.order)


def sections(store: Store, problem: Path, variants: Sequence[Variant], title: str) -> list[Section]:
    """Cost errors against steps and time, drivers beside each other."""
    reference = store.get(references_of(problem), "cost") or {}
    measured = [v for v in variants if rows_of(store, problem, v)]
    texts, pictures = [_reference_text(reference), _ORDERS], []
    names = dict.fromkeys(name for v in measured for name in found_of(store, problem, v).switching)
    if names:
        texts.append(_SWITCHING.format(names=listed(list(names))))
    lines = [_line(store, problem, v) for v in measured]
    if any(error for line in lines for error in line.errors):
        floor = reference["error"] / (abs(reference["cost"]) or 1.0)
        least = min(error for line in lines for error in line.errors if error)
        caption = "Relative error of the cost against number of intervals and against solve time; dashed: variational."
        drawn = svg(
            lambda: work_precision([("relative error of cost", lines)], floor if floor > NEAR * least else None)
        )
        pictures.append(Picture(caption, drawn))
    tables = [_table(store, problem, measured), _runs(store, problem, measured)]
    found = dict(store.rows(drivers_of(problem)))
    if found:
        tables.append(_drivers_table(found, reference.get("cost")))
        bars = [(name, v["seconds"], v["status"] == "solved") for name, v in found.items() if v["seconds"]]
        steps = next(iter(found.values()))["steps"]
        pictures.append(Picture(f"Drivers on {steps} intervals.", svg(lambda: times_of_drivers(bars))))
    return [Section(title, tuple(texts), tuple(tables), tuple(pictures))]


def _reference_text(reference: Values) -> str:
    if reference.get("cost") is None:
        return f"There is no reference cost: {reference.get('how', 'no scheme was built')}."
    relative = reference["error"] / (abs(reference["cost"]) or 1.0)
    accuracy = f"; which may be wrong by {number(relative, 2)} of it" if relative > 1e-14 else ""
    return f"Reference cost {reference['cost']:.12g}: {reference['how']}{accuracy}."


def _line(store: Store, problem: Path, variant: Variant) -> Line:
    rows = rows_of(store, problem, variant)
    return Line(variant.scheme, variant.method, variant.order, [v["steps"] for v in rows],
                [v["seconds"] for v in rows], errors(store, problem, variant))  # fmt: skip


def _table(store: Store, problem: Path, variants: Sequence[Variant]) -> Table:
    """Orders by mesh sequences."""
    rows = []
    for variant in variants:
        found, expected = found_of(store, problem, variant), expected_order(store, problem, variant)
        grids = f"{found.order.coarsest} to {found.order.finest}" if found.order else "–"
        kind = f"bounds of {', '.join(found.switching)}" if found.switching else "smooth"
        rows.append((
            variant.label, str(variant.order), str(expected), order_text(found.order, expected, found.said), grids,
            "–" if found.finest is None else str(found.finest), number(found.error, 2), kind, found.remark,
        ))  # fmt: skip
    head = ("scheme", "scheme's order", "expected of the cost", "measured", "at N", "finest N", "relative error there",
            "optimum", "remarks")  # fmt: skip
    return without_empty_columns(Table("The order of the cost's error, by mesh sequences.", head, tuple(rows)))


def _runs(store: Store, problem: Path, variants: Sequence[Variant]) -> Table:
    """The finest solve of each scheme from the problem's own guess."""
    rows = []
    for variant in variants:
        values, wrong = rows_of(store, problem, variant), errors(store, problem, variant)
        last = values[-1]
        failed = [f"{v['steps']}: {v['status']}" for v in values if v["status"] != "solved"]
        if wrong[-1] is not None and wrong[-1] > OTHER_OPTIMUM:
            failed.append("far from the reference: too few intervals, or another local optimum")
        rows.append((
            variant.label, f"{last['steps']}", "–" if last["cost"] is None else f"{last['cost']:.9g}",
            number(wrong[-1], 2), seconds(last["seconds"]), str(last["iterations"]), number(last["residual"], 2),
            number(last["stationarity"], 2), "; ".join(failed),
        ))  # fmt: skip
    head = ("scheme", "N", "cost", "relative error", "solve time", "iterations", "residual", "stationarity",
            "remarks")  # fmt: skip
    caption = "The finest solve of every scheme from the problem's own guess, on the grids that the figure shows."
    return without_empty_columns(Table(caption, head, tuple(rows)))


def _drivers_table(found: dict[str, Values], exact: float | None) -> Table:
    newton = (found.get("newton") or {}).get("seconds") or math.nan
    rows, refused = [], list[str]()
    for name, values in found.items():
        if values["seconds"] is None:
            rows.append((name, values["status"], *["–"] * 6))
            refused.append(f"{values['message']}.")
            continue
        rows.append((
            name, values["status"], seconds(values["seconds"]), number(values["seconds"] / newton),
            str(values["iterations"]), number(values["residual"], 2), number(values["stationarity"], 2),
            number(relative_error(values, exact), 2),
        ))  # fmt: skip
    head = ("driver", "status", "solve time", "× newton", "iterations", "residual", "stationarity",
            "relative error of cost")  # fmt: skip
    steps = next(iter(found.values()))["steps"]
    caption = f"Drivers on {steps} intervals of the default scheme, each from the problem's own guess."
    return Table(" ".join([caption, *(text[0].upper() + text[1:] for text in refused)]), head, tuple(rows))


__all__ = ["errors", "expected_order", "optima", "order_of", "relative_error", "rows_of", "sections", "verdict_of"]
