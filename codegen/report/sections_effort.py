"""What efficient midpoint steps and higher orders cost (the last questions of chapter 6), and the ansatz of B.2."""

from __future__ import annotations

from functools import partial

from codegen.report import accuracy, ansatz, effort, figures
from codegen.report import figures_questions as drawn
from codegen.report.section import Picture, Section, Table, number, seconds, slope
from codegen.report.settings import Settings
from codegen.report.store import Store


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
    rows, texts, cheapest = [], [], dict[float, tuple[float, str]]()
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
        for limit in (1e-2, 1e-4, 1e-6, 1e-8):
            times = [v["seconds"] for v, e in zip(found, errors, strict=True) if e <= limit]
            if times and (limit not in cheapest or min(times) < cheapest[limit][0]):
                cheapest[limit] = (min(times), scheme)
    for name, values in store.rows(accuracy.TOLERANCES):
        for limit in (1e-2, 1e-4, 1e-6, 1e-8):
            good = values["status"] == "solved" and abs(values["cost"] - exact) <= limit
            if good and (limit not in cheapest or values["seconds"] < cheapest[limit][0]):
                cheapest[limit] = (values["seconds"], name)
    for limit, (time, scheme) in sorted(cheapest.items(), reverse=True):
        texts.append(f"An error in cost below {limit:g} is had soonest from {scheme}, in {seconds(time)}.")
    most = max((len(row) for row in rows), default=2)
    padded = tuple((*row[:-1], *["–"] * (most - len(row)), row[-1]) for row in rows)
    head = ("scheme", *(f"N = {n}" for n in (5, 10, 20, 40, 80)[: most - 2]), "order")
    table = Table("Error in cost and seconds on forty landmarks, compiled.", head, padded)
    picture = Picture(
        "Error against time on forty landmarks; crosses: adaptive codes of scipy at the tolerances of the sweep.",
        figures.svg(partial(drawn.work_and_precision, store)),
    )
    return Section("Question 6: do higher orders pay, compiled?", tuple(texts), (table,), (picture,))


def _ansatz(store: Store) -> Section:
    rows = [
        (name, number(v["largest defect"], 2), number(v["largest rate"], 2)) for name, v in store.rows(ansatz.SECTION)
    ]
    worst = max((v["largest defect"] / v["largest rate"] for _, v in store.rows(ansatz.SECTION)), default=1.0)
    word = "vanishes up to the error of the differences" if worst < 1e-6 else "does NOT vanish"
    text = (
        f"The left side of the weak equation {word}: at most {number(worst, 2)} of its first term. That it "
        "vanishes "
        "for every kernel and every test function is proved by computer algebra (codegen.analysis.weak_solution)."
    )
    table = Table(
        "Fifteen random test functions along the motion: the largest left side, and the largest first term alone.",
        ("landmarks", "left side", "first term"),
        tuple(rows),
    )
    return Section("The particle ansatz as a weak solution (B.2)", (text,), (table,))
