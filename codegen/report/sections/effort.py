"""What efficient midpoint steps and higher orders cost (the last questions of chapter 6), and the ansatz of B.2."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

from codegen.report.figures import landmarks as figures
from codegen.report.figures import questions as drawn
from codegen.report.measure import accuracy, ansatz, effort, fastest
from codegen.report.section import Picture, Section, Table, listed, number, seconds, slope
from codegen.report.settings import Settings
from codegen.report.store import Store

_COMPARED = ("explicit-euler", "midpoint", "dop853")


def sections(settings: Settings, store: Store) -> list[Section]:
    """Questions 5 and 6, then the particle ansatz."""
    return [_midpoint(settings, store), _orders(store), _ansatz(store)]


def _midpoint(settings: Settings, store: Store) -> Section:
    texts, rows = [], []
    for count in (*settings.counts, 40):
        ours = store.get(effort.SECTION, f"generated; nc {count}")
        nested = store.get(effort.SECTION, f"nested fsolve; nc {count}")
        if ours is None:
            continue
        gain = None if nested is None else nested["seconds"] / ours["midpoint seconds"]
        rows.append(
            (
                str(count),
                seconds(ours["midpoint seconds"]),
                seconds(ours["explicit-euler seconds"]),
                number(ours["midpoint seconds"] / ours["explicit-euler seconds"], 2),
                number(ours["midpoint trajectory"] / ours["explicit-euler trajectory"], 2),
                seconds(nested["seconds"]) if nested else "–",
                number(gain, 2),
            )
        )
        if count == 40:
            thesis = 9399.0 / 19.14
            ratio = ours["midpoint seconds"] / ours["explicit-euler seconds"]
            word = "less" if ratio < thesis else "more"
            texts.append(
                f"Forty landmarks, N = 10: midpoint stepping takes {number(ratio, 2)} times as long as explicit Euler, "
                f"{word} than the thesis's {number(thesis, 3)}."
            )
    head = (
        "nc",
        "midpoint",
        "explicit Euler",
        "ratio",
        "ratio of trajectories",
        "nested fsolve, as in the thesis",
        "its time / ours",
    )
    table = Table(
        "Processor time of midpoint stepping, N = 10: Newton's method with generated derivatives inside each step and "
        "for the initial momenta, beside root finders with differences inside root finders.",
        head,
        tuple(rows),
    )
    return Section("Question 5: can midpoint stepping be made efficient?", tuple(texts), (table,))


def _orders(store: Store) -> Section:
    exact = (store.get(accuracy.REFERENCES, "nc 40") or {})["cost"]
    rows = []
    for scheme in accuracy.SCHEMES:
        found = [
            v for name, v in store.rows(accuracy.WORK) if name.startswith(f"{scheme};") and v["status"] == "solved"
        ]
        if not found:
            continue
        errors = [abs(v["cost"] - exact) for v in found]
        kept = [(v["steps"], e) for v, e in zip(found, errors, strict=True) if e > 1e-11]
        order = -slope([n for n, _ in kept], [e for _, e in kept])
        rows.append(
            (
                scheme,
                *(f"{number(e, 2)} in {seconds(v['seconds'])}" for v, e in zip(found, errors, strict=True)),
                number(order, 2),
            )
        )
    most = max((len(row) for row in rows), default=2)
    padded = tuple((*row[:-1], *["–"] * (most - len(row)), row[-1]) for row in rows)
    head = ("scheme", *(f"N = {n}" for n in (5, 10, 20, 40, 80)[: most - 2]), "order")
    table = Table("Error in cost and seconds on forty landmarks, compiled.", head, padded)
    picture = Picture(
        "Error against time on forty landmarks; crosses: adaptive codes of scipy at the tolerances of the sweep.",
        figures.svg(partial(drawn.work_and_precision, store)),
    )
    texts, fastest_table = _fastest(store)
    return Section("Question 6: do higher orders pay, compiled?", texts, (fastest_table, table), (picture,))


def _fastest(store: Store) -> tuple[tuple[str, ...], Table]:
    """Who reaches which error first, and how much longer explicit Euler and DOP853 take."""
    texts, columns = [], []
    for target in fastest.TARGETS:
        found = {s: store.get(fastest.SECTION, f"{s}; {target:g}") for s in (*fastest.STEPPED, *fastest.ADAPTIVE)}
        reached = {scheme: v for scheme, v in found.items() if v is not None and v["reached"]}
        columns.append({s: f"{v['steps']} in {seconds(v['seconds'])}" for s, v in reached.items()})
        if reached:
            best = min(reached, key=lambda scheme: reached[scheme]["seconds"])
            others = listed([_compared(s, reached, best) for s in _COMPARED if s != best])
            time, steps = reached[best]["seconds"], reached[best]["steps"]
            texts.append(f"Error below {target:g}: {best} with {steps} steps, in {seconds(time)}; {others}.")
    rows = tuple((s, *(column.get(s, "–") for column in columns)) for s in (*fastest.STEPPED, *fastest.ADAPTIVE))
    table = Table(
        "Fewest steps, or loosest tolerance of four a decade, that meet an error in cost on forty landmarks, and wall-"
        "clock time; a dash where 3000 steps do not suffice.",
        ("scheme", *(f"{target:g}" for target in fastest.TARGETS)),
        rows,
    )
    return tuple(texts), table


def _compared(scheme: str, reached: Mapping[str, Any], best: str) -> str:
    if scheme not in reached:
        return f"{scheme} does not get there"
    return f"{scheme} takes {number(reached[scheme]['seconds'] / reached[best]['seconds'], 2)} times as long"


def _ansatz(store: Store) -> Section:
    rows = [
        (name, number(v["largest defect"], 2), number(v["largest rate"], 2)) for name, v in store.rows(ansatz.SECTION)
    ]
    worst = max((v["largest defect"] / v["largest rate"] for _, v in store.rows(ansatz.SECTION)), default=1.0)
    word = "vanishes up to the error of the differences" if worst < 1e-6 else "does NOT vanish"
    text = (
        f"The left side of the weak equation {word}: at most {number(worst, 2)} of its first term. That it vanishes "
        "for every kernel and every test function is proved by computer algebra (tests/analysis/test_weak_solution.py)."
    )
    table = Table(
        "Fifteen random test functions along the motion: the largest left side, and the largest first term alone.",
        ("landmarks", "left side", "first term"),
        tuple(rows),
    )
    return Section("The particle ansatz as a weak solution (B.2)", (text,), (table,))
