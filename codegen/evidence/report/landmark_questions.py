"""The questions that the thesis leaves open in chapter 6, each answered by what was measured."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

from codegen.evidence.report import landmark_effort, landmark_figures, landmark_motion
from codegen.evidence.report.page import Picture, Section, Table, listed, number, seconds, slope
from codegen.evidence.report.settings import Settings
from codegen.evidence.report.store import Store

_COMPARED = ("explicit-euler", "midpoint", "dop853")


def _midpoint(settings: Settings, store: Store) -> Section:
    texts, rows = [], []
    for count in (*settings.counts, 40):
        ours = store.get(landmark_effort.MIDPOINT_SECTION, f"generated; nc {count}")
        nested = store.get(landmark_effort.MIDPOINT_SECTION, f"nested fsolve; nc {count}")
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
    exact = (store.get(landmark_effort.REFERENCES, "nc 40") or {})["cost"]
    rows = []
    for scheme in landmark_effort.SCHEMES:
        found = [
            v
            for name, v in store.rows(landmark_effort.WORK)
            if name.startswith(f"{scheme};") and v["status"] == "solved"
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
        landmark_figures.svg(partial(landmark_figures.work_and_precision, store)),
    )
    texts, fastest_table = _fastest(store)
    return Section("Question 6: do higher orders pay, compiled?", texts, (fastest_table, table), (picture,))


def _fastest(store: Store) -> tuple[tuple[str, ...], Table]:
    """Who reaches which error first, and how much longer explicit Euler and DOP853 take."""
    texts, columns = [], []
    for target in landmark_effort.TARGETS:
        found = {
            s: store.get(landmark_effort.FASTEST_SECTION, f"{s}; {target:g}")
            for s in (*landmark_effort.STEPPED, *landmark_effort.ADAPTIVE)
        }
        reached = {scheme: v for scheme, v in found.items() if v is not None and v["reached"]}
        columns.append({s: f"{v['steps']} in {seconds(v['seconds'])}" for s, v in reached.items()})
        if reached:
            best = min(reached, key=lambda scheme: reached[scheme]["seconds"])
            others = listed([_compared(s, reached, best) for s in _COMPARED if s != best])
            time, steps = reached[best]["seconds"], reached[best]["steps"]
            texts.append(f"Error below {target:g}: {best} with {steps} steps, in {seconds(time)}; {others}.")
    rows = tuple(
        (s, *(column.get(s, "–") for column in columns)) for s in (*landmark_effort.STEPPED, *landmark_effort.ADAPTIVE)
    )
    table = Table(
        "Fewest steps, or loosest tolerance of four a decade, that meet an error in cost on forty landmarks, and wall-"
        "clock time; a dash where 3000 steps do not suffice.",
        ("scheme", *(f"{target:g}" for target in landmark_effort.TARGETS)),
        rows,
    )
    return tuple(texts), table


def _compared(scheme: str, reached: Mapping[str, Any], best: str) -> str:
    if scheme not in reached:
        return f"{scheme} does not get there"
    return f"{scheme} takes {number(reached[scheme]['seconds'] / reached[best]['seconds'], 2)} times as long"


def _ansatz(store: Store) -> Section:
    rows = [
        (name, number(v["largest defect"], 2), number(v["largest rate"], 2))
        for name, v in store.rows(landmark_effort.WEAK_SOLUTION_SECTION)
    ]
    worst = max(
        (v["largest defect"] / v["largest rate"] for _, v in store.rows(landmark_effort.WEAK_SOLUTION_SECTION)),
        default=1.0,
    )
    word = "vanishes up to the error of the differences" if worst < 1e-6 else "does NOT vanish"
    text = (
        f"The left side of the weak equation {word}: at most {number(worst, 2)} of its first term. That it vanishes "
        "for every kernel and every test function is proved by computer algebra (tests/evidence/test_weak_solution.py)."
    )
    table = Table(
        "Fifteen random test functions along the motion: the largest left side, and the largest first term alone.",
        ("landmarks", "left side", "first term"),
        tuple(rows),
    )
    return Section("The particle ansatz as a weak solution (B.2)", (text,), (table,))


_THESIS = ("nodes", "curved", landmark_motion.LOOSE)
"""How the thesis minimised."""
_JUMP = 5.0


def sections(settings: Settings, store: Store) -> list[Section]:
    """Questions in the order of chapter 6, then the check of appendix B.2."""
    return [
        _paths(settings, store),
        _dimension(store),
        _smoothness(store),
        _jumps(settings, store),
        *[_midpoint(settings, store), _orders(store), _ansatz(store)],
    ]


def _paths(settings: Settings, store: Store) -> Section:
    sets = [f"nc {n}" for n in (*settings.counts, 40)] + ["nc 100, smooth"]
    rows, texts = [], []
    for kind, meaning in landmark_motion.KINDS.items():
        found = [store.get(landmark_motion.PATHS_SECTION, f"{kind}; {name}") for name in sets]
        cells = [_iterations(values) for values in found]
        far = [v["distance of places"] for v in found if v is not None and v["distance of places"] is not None]
        rows.append((meaning, *cells, number(max(far), 2) if far else "–"))
    for name in sets:
        of_kind = {kind: store.get(landmark_motion.PATHS_SECTION, f"{kind}; {name}") for kind in landmark_motion.KINDS}
        solved = {kind: v["iterations"] for kind, v in of_kind.items() if v is not None and v["solved"]}
        failed = [kind for kind, v in of_kind.items() if v is not None and not v["solved"]]
        if not solved:
            texts.append(f"{name}: no guess leads to a solution.")
            continue
        least = min(solved.values())
        best = [kind for kind, made in solved.items() if made == least]
        old = solved.get("curved")
        compared = (
            "the curved path fails"
            if old is None
            else ("the curved path needs as few" if old == least else f"the curved path needs {old}")
        )
        texts.append(
            f"{name}: fewest iterations, {least}, from {listed(best)}; {compared}"
            + (f"; from {listed(failed)} there is no convergence." if failed else ".")
        )
    table = Table(
        f"Iterations of Newton's method for all states at once, explicit Euler, N = {landmark_motion.PATHS_STEPS}, and "
        "how far the guessed places are from the solution at most.",
        ("initial path", *sets, "distance"),
        tuple(rows),
    )
    return Section("Question 1: can better initial paths be generated?", tuple(texts), (table,))


def _iterations(values: Any) -> str:
    if values is None:
        return "–"
    return str(values["iterations"]) if values["solved"] else f"fails ({values['iterations']})"


def _dimension(store: Store) -> Section:
    lines, texts, rows = landmark_figures.by_kernel(store), [], []
    for name, found in lines.items():
        big = [(n, v) for n, v in found if n >= 20]
        exponents = [
            slope([n for n, _ in big], [v[key] for _, v in big]) for key in ("seconds of a trajectory", "seconds")
        ]
        last = found[-1]
        operations = last[1]["operations"]
        rows.append(
            (
                name,
                str(operations[1]),
                str(last[0]),
                seconds(last[1]["seconds of a trajectory"]),
                seconds(last[1]["seconds"]),
                *(number(e, 2) for e in exponents),
            )
        )
    for kernel in ("gauss", "plate"):
        pair = [lines.get(f"{kernel} {d}-D") for d in (2, 3)]
        if pair[0] and pair[1]:
            count = min(pair[0][-1][0], pair[1][-1][0])
            times = [dict(line)[count]["seconds of a trajectory"] for line in pair if line]
            texts.append(
                f"{kernel}: {count} landmarks in space take {number(times[1] / times[0], 2)} times as long "
                "for a trajectory as in the plane."
            )
    texts.append(
        "The dimension changes the operations of each pair only, whose numbers the table gives; logarithms and roots "
        "among them count as one each, though they take longer. Growth with the number of landmarks is measured below."
    )
    table = Table(
        "Growth with the number of landmarks: exponents from 20 landmarks on; operations for each pair as emitted.",
        ("kernel", "operations", "landmarks", "trajectory", "solve", "exponent, trajectory", "exponent, solve"),
        tuple(rows),
    )
    picture = Picture(
        "Processor time of a trajectory and of a solve, explicit Euler, N = 10.",
        landmark_figures.svg(partial(landmark_figures.dimension_figure, store)),
    )
    return Section(
        "Question 2: how do the methods scale with the dimension of space?", tuple(texts), (table,), (picture,)
    )


def _smoothness(store: Store) -> Section:
    texts, rows = [], []
    for amplitude in landmark_motion.AMPLITUDES:
        found = landmark_figures.warps(store, amplitude)
        if not found:
            texts.append(f"Displacements × {amplitude:g}: too few of the warps were solved.")
            continue
        order = -slope([v["steps"] for v in found if v["steps"] >= 5], [v["error"] for v in found if v["steps"] >= 5])
        steps = {limit: next((v["steps"] for v in found if v["error"] <= limit), None) for limit in (1e-2, 1e-3)}
        unfolded = [v["steps"] for v in found if v["least area"] > 0.0]
        folded = [v["steps"] for v in found if v["least area"] <= 0.0]
        rows.append(
            (
                f"× {amplitude:g}",
                number(found[0]["exact least area"], 3),
                *(("> 80" if n is None else str(n)) for n in steps.values()),
                listed([str(n) for n in folded]),
                number(found[-1]["steepest"] * found[-1]["steps"], 3),
                number(order, 2),
            )
        )
        if folded and unfolded:
            texts.append(f"Displacements × {amplitude:g} fold the grid with N = {listed([str(n) for n in folded])}.")
    if rows:
        texts.append(
            "Displacements "
            + "; ".join(f"{row[0]} need N = {row[2]} for an error of 1e-2 and {row[3]} for 1e-3" for row in rows)
            + ". "
            + ("No warp folds." if all(row[4] == "none" for row in rows) else "Some warps fold.")
        )
    texts.append(
        "A single explicit step is one to one where h times the Lipschitz constant of v is below one; the constant "
        "that was measured tells how many steps guarantee it."
    )
    head = (
        "displacements",
        "least area, exact",
        "N for error 1e-2",
        "N for error 1e-3",
        "N that fold",
        "Lipschitz constant",
        "order",
    )
    table = Table(
        "The trilobites' landmarks with displacements multiplied, explicit Euler; the warp of a grid of the disc "
        "against that with 640 steps.",
        head,
        tuple(rows),
    )
    picture = Picture(
        "Error of the warp, and the least ratio by which areas change (dotted: with 640 steps); below zero there is "
        "a fold.",
        landmark_figures.svg(partial(landmark_figures.smoothness_figure, store)),
    )
    return Section(
        "Question 3: how many steps does a warp of given smoothness need?", tuple(texts), (table,), (picture,)
    )


def _jumps(settings: Settings, store: Store) -> Section:
    texts, rows = [], []
    for count in settings.counts[:2]:
        null = store.get(landmark_motion.JUMPS_SECTION, f"null space; nc {count}")
        if null is not None:
            texts.append(
                f"nc = {count}: with momenta on nodes, {null['nodes']} directions of the unknowns change neither the "
                f"cost nor a constraint; with momenta on intervals, {null['intervals']}."
            )
        for variant in landmark_motion.VARIANTS:
            found = landmark_figures.of_variant(settings, store, *variant, count)
            if not found:
                continue
            errors = [v["error"] for _, v in found]
            place, path, tolerance = variant
            rows.append(
                (
                    f"nc {count}, {place}, {path}, {tolerance:.0e}",
                    str(found[-1][0]),
                    number(min(errors), 2),
                    number(max(errors), 2),
                    number(max(v["constraints"] for _, v in found), 2),
                    number(max(v["stationarity"] for _, v in found), 2),
                    _span([v["iterations"] for _, v in found], "–"),
                    number(max(v["alternating"] for _, v in found), 2),
                )
            )
        texts += _verdict(settings, store, count)
    head = (
        "variant",
        "N up to",
        "least error",
        "largest error",
        "constraints",
        "stationarity",
        "iterations",
        "alternating part",
    )
    table = Table(
        "Midpoint rule as a minimisation by SLSQP: error of its cost against Newton's minimum of the same discrete "
        "problem, largest residuals where it stopped, iterations, and the largest alternating part of nodal momenta.",
        head,
        tuple(rows),
    )
    picture = Picture(
        "Error and time of SLSQP: red with momenta on nodes as in the thesis, blue on intervals; full lines from "
        "curved and dotted ones from straight paths at tolerance 1e-6, dashes at 1e-14.",
        landmark_figures.svg(partial(landmark_figures.jump_figure, settings, store)),
    )
    return Section(
        "Question 4: what happens inside the optimiser in Figures 5.8 and 5.9?", tuple(texts), (table,), (picture,)
    )


def _verdict(settings: Settings, store: Store, count: int) -> list[str]:
    """What the comparison of tolerances, places of momenta and paths says, for one set of landmarks."""
    worst = {}
    for variant in landmark_motion.VARIANTS:
        found = landmark_figures.of_variant(settings, store, *variant, count)
        if found:
            worst[variant] = max(v["error"] for _, v in found)
    loose = [error for (_, _, tolerance), error in worst.items() if tolerance == landmark_motion.LOOSE]
    tight = [error for (_, _, tolerance), error in worst.items() if tolerance == landmark_motion.TIGHT]
    if not loose or not tight:
        return []
    texts = []
    if max(loose) > 100.0 * max(tight):
        texts.append(
            f"nc = {count}: at tolerance 1e-6 the optimiser stops early, up to {number(max(loose), 2)} from the "
            f"minimum; at 1e-14 within {number(max(tight), 2)}: errors of this kind come from the tolerance."
        )
    else:
        texts.append(
            f"nc = {count}: the tolerance does not decide: errors are up to {number(max(loose), 2)} at 1e-6 and up to "
            f"{number(max(tight), 2)} at 1e-14."
        )
    seen = {variant: _jumps_at(settings, store, variant, count) for variant in worst}
    with_jumps = [f"{_named(v)} at N = {listed([str(n) for n in at])}" for v, at in seen.items() if at]
    without = [_named(v) for v, at in seen.items() if not at]
    thesis = seen.get(("nodes", "curved", landmark_motion.LOOSE), [])
    outcome = "are reproduced" if thesis else "are not reproduced as far as N went"
    texts.append(
        f"nc = {count}: the thesis's jumps to faster and less accurate solves {outcome}. The error grows by a factor "
        f"of {_JUMP:g} or more from one N to the next as iterations fall: {'; '.join(with_jumps) or 'nowhere'}. "
        f"No such jump: {'; '.join(without) or 'nowhere'}."
    )
    if thesis:
        early = [
            v["iterations"] for n, v in landmark_figures.of_variant(settings, store, *_THESIS, count) if n in thesis
        ]
        texts.append(
            f"At these N the optimiser, started from the curved paths, is content after {_span(early, ' to ')} "
            "iterations, because the cost then changes by less than the tolerance though it is not stationary."
        )
    return texts


def _span(numbers: Sequence[Any], between: str) -> str:
    least, largest = min(numbers), max(numbers)
    return f"{least}" if least == largest else f"{least}{between}{largest}"


def _jumps_at(settings: Settings, store: Store, variant: tuple[str, str, float], count: int) -> list[int]:
    """Numbers of steps at which the error grows suddenly while iterations fall."""
    found = landmark_figures.of_variant(settings, store, *variant, count)
    return [
        n
        for (n, v), (_, before) in zip(found[1:], found[:-1], strict=True)
        if v["error"] > _JUMP * max(before["error"], 1e-12) and v["iterations"] < before["iterations"]
    ]


def _named(variant: tuple[str, str, float]) -> str:
    place, path, tolerance = variant
    return f"momenta on {place}, {path} paths, {tolerance:g}"
