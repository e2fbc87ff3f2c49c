"""Sections about a problem that is simulated."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from codegen.evidence.report.building import Variant
from codegen.evidence.report.landmark_figures import svg
from codegen.evidence.report.orders import (
    ABOVE_REFERENCE,
    LEAST_RANGE,
    SETTLED,
    SETTLED_HIGH,
    Order,
    order_text,
    verdict,
)
from codegen.evidence.report.page import Picture, Section, Table, listed, number, seconds, without_empty_columns
from codegen.evidence.report.problem_figures import Line, work_precision
from codegen.evidence.report.simulations import case_name, errors_of, order_from, orders_of, references_of
from codegen.evidence.report.store import Store, Values

_QUANTITIES = (("trajectory", "error of trajectory"), ("energy", "error of energy"), ("momentum", "error of momentum"))


def rows_of(store: Store, problem: Path, variant: Variant) -> list[Values]:
    """What was measured of a scheme, by growing number of steps."""
    rows = [v for name, v in store.rows(errors_of(problem)) if name.startswith(case_name(variant, 0)[:-1])]
    return sorted(rows, key=lambda values: values["steps"])


def errors(store: Store, problem: Path, variant: Variant) -> list[float | None]:
    """Errors of the trajectory, None where a run failed."""
    return [values.get("trajectory") for values in rows_of(store, problem, variant)]


def order_of(store: Store, problem: Path, variant: Variant) -> Order | None:
    """The measured order of a scheme, from errors of the state on a short span."""
    return order_from(store.get(orders_of(problem), variant.label))


def expected_order(store: Store, problem: Path, variant: Variant) -> int:
    """The order that a simulation is to have: the scheme's own."""
    del store, problem
    return variant.order


def verdict_of(store: Store, problem: Path, variant: Variant) -> str:
    """What is to be said of the measured order; nothing where it is the stated one."""
    return verdict(order_of(store, problem, variant), variant.order)


def sections(store: Store, problem: Path, variants: Sequence[Variant], title: str) -> list[Section]:
    """Errors against steps and time, and a table of schemes."""
    reference = store.get(references_of(problem), "motion")
    measured = [v for v in variants if rows_of(store, problem, v)]
    if reference is None or not measured:
        return [Section(title, ("No scheme of this problem could be compared with a reference.",))]
    groups = []
    for key, name in _QUANTITIES:
        lines = [_line(store, problem, v, key) for v in measured]
        if any(error for line in lines for error in line.errors):
            groups.append((name, lines))
    texts = [
        f"Errors are the largest at {len(reference['times']) - 1} equidistant times, relative to the largest place or "
        f"momentum, those of energy to the largest sum of |p q̇|. "
        f"Reference: {reference['how']}; a looser tolerance differs from it by "
        f"{number(reference['error'], 2)}.",
        _of_orders(store, problem, measured),
        _conserved(reference["conserved"]),
        _fastest(store, problem, measured),
    ]
    picture = Picture(
        "Error against number of steps and against run time; dashed: variational. Lines that lie upon each other are "
        "the same map.",
        svg(lambda: work_precision(groups, reference["error"])),
    )
    table = _table(store, problem, measured)
    return [Section(title, tuple(t for t in texts if t), (table,), (picture,))]


def _of_orders(store: Store, problem: Path, variants: Sequence[Variant]) -> str:
    """How orders were measured."""
    spans = sorted({values["span"] for v in variants if (values := store.get(orders_of(problem), v.label))})
    return (
        f"Orders are measured on a short span of the motion, of duration {listed([number(s) for s in spans])}, so that "
        "rounding does not come before the asymptotic range. The number of steps N grows by a third of a doubling at a "
        f"time until the orders between neighbours agree within {SETTLED:g} ({SETTLED_HIGH:g} for high orders) "
        f"over a range of {LEAST_RANGE:g} or more in N, at {ABOVE_REFERENCE:g} times the reference's error or above; "
        "the finest such range counts. Where there is none, convergence is called not asymptotic."
    )


def _conserved(names: Sequence[str]) -> str:
    return f"Conserved by Noether's theorem, and compared: {listed(names)}." if names else ""


def _fastest(store: Store, problem: Path, variants: Sequence[Variant]) -> str:
    """The scheme that is first below each of some errors, with its time beside that of the default scheme."""
    said = []
    for error in (1e-3, 1e-6, 1e-9, 1e-12):
        times = [(t, v) for v in variants if (t := time_to(rows_of(store, problem, v), error)) is not None]
        if times:
            least, best = min(times, key=lambda pair: pair[0])
            own = next((t for t, v in times if v == variants[0]), None)
            beside = f", {number(own / least, 2)} times as fast as {variants[0].label}" if own and own > least else ""
            said.append(f"{number(error, 1)} by {best.label} in {seconds(least)}{beside}")
    return f"Fastest to an error of the trajectory of {'; '.join(said)}." if said else ""


def _line(store: Store, problem: Path, variant: Variant, key: str) -> Line:
    rows = rows_of(store, problem, variant)
    return Line(
        variant.scheme, variant.method, variant.order, [v["steps"] for v in rows], [v["seconds"] for v in rows],
        [v.get(key) for v in rows],
    )  # fmt: skip


def _table(store: Store, problem: Path, variants: Sequence[Variant]) -> Table:
    """Orders, best errors, and the time that a trajectory error of 1e-3 and 1e-6 takes."""
    rows = []
    for variant in variants:
        values = rows_of(store, problem, variant)
        solved = [v for v in values if v.get("trajectory") is not None]
        last, order = solved[-1] if solved else None, order_of(store, problem, variant)
        rows.append((
            variant.label,
            str(variant.order),
            order_text(order, variant.order),
            f"{order.coarsest} to {order.finest}" if order else "–",
            number(min((v["trajectory"] for v in solved), default=None), 2),
            number(min((v["energy"] for v in solved), default=None), 2),
            seconds(time_to(values, 1e-3)),
            seconds(time_to(values, 1e-6)),
            number(1e9 * last["seconds"] / last["steps"]) if last else "–",
            str(len(values) - len(solved)) if len(values) > len(solved) else "",
        ))  # fmt: skip
    head = (
        "scheme", "stated order", "measured", "at N", "least error of trajectory", "of energy", "time to 1e-3",
        "time to 1e-6",
        "ns per step", "failed runs",
    )  # fmt: skip
    caption = "Measured orders, least errors, and the time of the cheapest run with at most that error."
    return without_empty_columns(Table(caption, head, tuple(rows)))


def time_to(values: Sequence[Values], error: float) -> float | None:
    """Seconds of the cheapest run whose trajectory is that accurate."""
    return min((v["seconds"] for v in values if (v.get("trajectory") or 1e300) <= error), default=None)
