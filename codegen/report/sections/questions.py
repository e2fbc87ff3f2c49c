"""The questions that the thesis leaves open in chapter 6, each answered by what was measured."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

from codegen.report.figures import landmarks as figures
from codegen.report.figures import questions as drawn
from codegen.report.measure import jumps, paths, smoothness
from codegen.report.section import Picture, Section, Table, listed, number, seconds, slope
from codegen.report.sections.effort import sections as of_effort
from codegen.report.settings import Settings
from codegen.report.store import Store

_THESIS = ("nodes", "curved", jumps.LOOSE)
"""How the thesis minimised."""
_JUMP = 5.0


def sections(settings: Settings, store: Store) -> list[Section]:
    """Questions in the order of chapter 6, then the check of appendix B.2."""
    return [
        _paths(settings, store),
        _dimension(store),
        _smoothness(store),
        _jumps(settings, store),
        *of_effort(settings, store),
    ]


def _paths(settings: Settings, store: Store) -> Section:
    sets = [f"nc {n}" for n in (*settings.counts, 40)] + ["nc 100, smooth"]
    rows, texts = [], []
    for kind, meaning in paths.KINDS.items():
        found = [store.get(paths.SECTION, f"{kind}; {name}") for name in sets]
        cells = [_iterations(values) for values in found]
        far = [v["distance of places"] for v in found if v is not None and v["distance of places"] is not None]
        rows.append((meaning, *cells, number(max(far), 2) if far else "–"))
    for name in sets:
        of_kind = {kind: store.get(paths.SECTION, f"{kind}; {name}") for kind in paths.KINDS}
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
        f"Iterations of Newton's method for all states at once, explicit Euler, N = {paths.STEPS}, and how far the "
        "guessed places are from the solution at most.",
        ("initial path", *sets, "distance"),
        tuple(rows),
    )
    return Section("Question 1: can better initial paths be generated?", tuple(texts), (table,))


def _iterations(values: Any) -> str:
    if values is None:
        return "–"
    return str(values["iterations"]) if values["solved"] else f"fails ({values['iterations']})"


def _dimension(store: Store) -> Section:
    lines, texts, rows = drawn.by_kernel(store), [], []
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
        figures.svg(partial(drawn.dimension_figure, store)),
    )
    return Section(
        "Question 2: how do the methods scale with the dimension of space?", tuple(texts), (table,), (picture,)
    )


def _smoothness(store: Store) -> Section:
    texts, rows = [], []
    for amplitude in smoothness.AMPLITUDES:
        found = drawn.warps(store, amplitude)
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
                *(_steps(n) for n in steps.values()),
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
        figures.svg(partial(drawn.smoothness_figure, store)),
    )
    return Section(
        "Question 3: how many steps does a warp of given smoothness need?", tuple(texts), (table,), (picture,)
    )


def _steps(steps: int | None) -> str:
    return "> 80" if steps is None else str(steps)


def _jumps(settings: Settings, store: Store) -> Section:
    texts, rows = [], []
    for count in settings.counts[:2]:
        null = store.get(jumps.SECTION, f"null space; nc {count}")
        if null is not None:
            texts.append(
                f"nc = {count}: with momenta on nodes, {null['nodes']} directions of the unknowns change neither the "
                f"cost nor a constraint; with momenta on intervals, {null['intervals']}."
            )
        for variant in jumps.VARIANTS:
            found = drawn.of_variant(settings, store, *variant, count)
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
        figures.svg(partial(drawn.jump_figure, settings, store)),
    )
    return Section(
        "Question 4: what happens inside the optimiser in Figures 5.8 and 5.9?", tuple(texts), (table,), (picture,)
    )


def _verdict(settings: Settings, store: Store, count: int) -> list[str]:
    """What the comparison of tolerances, places of momenta and paths says, for one set of landmarks."""
    worst = {}
    for variant in jumps.VARIANTS:
        found = drawn.of_variant(settings, store, *variant, count)
        if found:
            worst[variant] = max(v["error"] for _, v in found)
    loose = [error for (_, _, tolerance), error in worst.items() if tolerance == jumps.LOOSE]
    tight = [error for (_, _, tolerance), error in worst.items() if tolerance == jumps.TIGHT]
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
    thesis = seen.get(("nodes", "curved", jumps.LOOSE), [])
    outcome = "are reproduced" if thesis else "are not reproduced as far as N went"
    texts.append(
        f"nc = {count}: the thesis's jumps to faster and less accurate solves {outcome}. The error grows by a factor "
        f"of {_JUMP:g} or more from one N to the next as iterations fall: {'; '.join(with_jumps) or 'nowhere'}. "
        f"No such jump: {'; '.join(without) or 'nowhere'}."
    )
    if thesis:
        early = [v["iterations"] for n, v in drawn.of_variant(settings, store, *_THESIS, count) if n in thesis]
        texts.append(
            f"At these N the optimiser, started from the curved paths, is content after {_span(early, ' to ')} "
            "iterations, because the cost then changes by less than the tolerance though it is not stationary."
        )
    return texts


def _span(numbers: Sequence[Any], between: str) -> str:
    """The least and the largest of some numbers, or the only one."""
    least, largest = min(numbers), max(numbers)
    return f"{least}" if least == largest else f"{least}{between}{largest}"


def _jumps_at(settings: Settings, store: Store, variant: tuple[str, str, float], count: int) -> list[int]:
    """Numbers of steps at which the error grows suddenly while iterations fall."""
    found = drawn.of_variant(settings, store, *variant, count)
    return [
        n
        for (n, v), (_, before) in zip(found[1:], found[:-1], strict=True)
        if v["error"] > _JUMP * max(before["error"], 1e-12) and v["iterations"] < before["iterations"]
    ]


def _named(variant: tuple[str, str, float]) -> str:
    place, path, tolerance = variant
    return f"momenta on {place}, {path} paths, {tolerance:g}"
