"""The study of landmark registration: measure missing cases, then write page, CSV and JSON.

The first sections of the page repeat Tables 5.1 and 5.2 and the figures of chapter 5 of the thesis, with conclusions
from the measured values. Sections on the open questions of chapter 6 follow.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path

from codegen.evidence.report import landmark_effort, landmark_motion
from codegen.evidence.report import landmark_figures as figures
from codegen.evidence.report.landmark_questions import question_sections
from codegen.evidence.report.page import Picture, Section, Table, listed, number, page, seconds, slope, svg
from codegen.evidence.report.store import Case, Settings, Store, Values
from codegen.files import write_text
from codegen.machine import machine
from codegen.terminal import progress

PARTS: tuple[tuple[str, Callable[[Settings, Store], Iterator[Case]]], ...] = (
    ("accuracy", landmark_effort.accuracy_cases),
    ("routes", landmark_effort.route_cases),
    ("fastest", landmark_effort.fastest_cases),
    ("initial paths", landmark_motion.path_cases),
    ("midpoint", landmark_effort.midpoint_cases),
    ("dimension", landmark_effort.dimension_cases),
    ("smoothness", landmark_motion.smoothness_cases),
    ("weak solution", landmark_effort.weak_solution_cases),
    ("jumps", landmark_motion.jump_cases),
)
"""The parts of the study, with functions that yield their cases, in the order of measurement."""

THESIS_TIMES = {3: (157.5, 381.0, 1.705, 41.80), 4: (831.6, 786.6, 2.974, 79.81), 5: (7345.0, 1543.0, 4.663, 205.4)}
"""Seconds of Table 5.1 by number of landmarks, N = 100: optimal control, full, stepping by fsolve and by fmin."""
_THESIS_ROUTES = ("action, slsqp", "full, fsolve", "stepping, fsolve", "stepping, fmin")
_NEWTON_ROUTES = ("action, newton", "full, newton", "stepping, newton")


def run(settings: Settings, folder: Path) -> Path:
    """Measure every case that `folder` does not contain; write page, CSV and JSON, and return the path of the page."""
    folder.mkdir(parents=True, exist_ok=True)
    store = Store(folder / ("quick.jsonl" if settings.quick else "measurements.jsonl"))
    with progress("", len(PARTS)) as report_progress:
        for done, (name, cases) in enumerate(PARTS):
            for case in cases(settings, store):
                report_progress(done, f"{name}: {case.name}")
                store.measured(case)
    environment = {
        **machine(),
        "problem": settings.problem.name,
        "quick": settings.quick,
        "seconds allowed for one solve before a route goes no further": settings.limit,
        "seeds": {
            "few landmarks": "numpy default_rng(nc)",
            "smooth displacements": "numpy default_rng(1)",
            "test functions": "numpy default_rng(5)",
        },
    }
    title = "Geodesic interpolating splines: the thesis's chapter 5 and its open questions, measured"
    introduction = (
        "Landmarks in the unit disc move by H = ½ Σ pᵢ·pⱼ G(qᵢ, qⱼ), G being the Green's function of the clamped "
        "plate, from given places to given places. Every number on this page was measured by the run that made it; "
        "sentences take their numbers, and what they claim, from these measurements. All of them are in "
        "measurements.csv beside this page."
    )
    if settings.quick:
        introduction += (
            " This is the quick form: one set of landmarks, three numbers of steps, the fast routes, no open questions."
        )
    path = folder / "index.html"
    write_text(folder / "measurements.csv", store.table())
    write_text(folder / "environment.json", json.dumps(environment, indent=2) + "\n")
    write_text(path, page(title, introduction, sections(settings, store), environment))
    return path


def sections(settings: Settings, store: Store) -> list[Section]:
    """Return the sections on chapter 5 of the thesis, and on its open questions."""
    text = (
        "Random landmarks as in the thesis's initialisation (E.3.6), drawn anew because Matlab's random numbers are "
        "not available: costs therefore differ from the thesis's, orders and routes may be compared."
    )
    points = Picture(
        "Figure 5.1: landmarks (× start, • end) and the curved paths from which iterations start.",
        svg(figures.landmarks, settings),
    )
    return [
        Section("Control points and initial paths", (text,), (), (points,)),
        _routes(settings, store, "explicit-euler", "5.1 Explicit Euler", "5.2–5.4", "5.5–5.7"),
        _eulers(settings, store),
        _routes(settings, store, "midpoint", "5.2 Midpoint rule", "5.8–5.10", "5.11–5.13"),
        _best(settings, store),
        _forty(store),
        _tolerances(store),
        *([] if settings.quick else question_sections(settings, store)),
    ]


def _eulers(settings: Settings, store: Store) -> Section:
    texts, steps = [], max(settings.steps)
    for count in settings.counts:
        exact = figures.reference_cost(store, count)
        errors = {}
        for scheme in ("explicit-euler", "symplectic-euler", "implicit-euler"):
            values = _stepping(store, scheme, count, steps)
            if values is not None and exact is not None and values["status"] == "solved":
                errors[scheme] = abs(values["cost"] - exact)
        if len(errors) > 1:
            best = min(errors, key=errors.__getitem__)
            ratio = max(errors.values()) / max(errors[best], 1e-300)
            word = "close to each other" if ratio < 3.0 else "not close to each other"
            names = listed([f"{name} {number(error)}" for name, error in errors.items()])
            texts.append(f"nc = {count}, N = {steps}: errors {names}; they are {word}, the best being {best}.")
    picture = Picture(
        "Errors in cost of the Euler methods, whose figures the thesis omits, and of the midpoint rule.",
        svg(figures.eulers, settings, store),
    )
    return Section("Symplectic and implicit Euler methods", tuple(texts), (), (picture,))


def _stepping(store: Store, scheme: str, count: int, steps: int) -> Values | None:
    """Return the values of a scheme by stepping with Newton's method, or None if they were not measured."""
    name = landmark_effort.case_name(scheme, figures.STEPPING, count, steps)
    return store.get(landmark_effort.ROUTES_SECTION, name)


def _routes(settings: Settings, store: Store, scheme: str, title: str, costs: str, paths: str) -> Section:
    """Return the section on the routes of a scheme; `costs` and `paths` are numbers of figures in the thesis."""
    by_route = {
        (route.label, count): dict(figures.by_route(settings, store, scheme, route.label, count))
        for route in landmark_effort.routes_of(scheme)
        for count in settings.counts
    }
    if scheme == "explicit-euler":
        rows = []
        for count in settings.counts:
            cells = [str(count)]
            for name, time in zip(_THESIS_ROUTES, THESIS_TIMES[count], strict=True):
                solve = by_route[name, count].get(100)
                measured = _time_or_reach(by_route[name, count], 100) if solve is None else seconds(solve["seconds"])
                cells += [f"{number(time, 4)} s", measured]
            rows.append((*cells, *(_time_or_reach(by_route[name, count], 100) for name in _NEWTON_ROUTES)))
        head = ["nc"]
        for name in ("optimal control", "full", "stepping fsolve", "stepping fmin"):
            head += [f"{name}, thesis", "here"]
        table = Table(
            "Table 5.1 redone: seconds of explicit Euler, N = 100, those of the thesis and ours (SLSQP for fmincon, "
            "MINPACK for fsolve, Nelder and Mead for fminsearch, all on generated derivatives). “N ≤” tells how far a "
            "route was taken within the time allowed.",
            (*head, *(f"{name} (generated)" for name in _NEWTON_ROUTES)),
            tuple(rows),
        )
    else:
        names, steps = list(dict.fromkeys(name for name, _ in by_route)), max(settings.steps)
        rows = [(str(n), *(_time_or_reach(by_route[name, n], steps) for name in names)) for n in settings.counts]
        table = Table(f"Seconds with N = {steps}", ("nc", *names), tuple(rows))
    pictures = (
        Picture(
            f"Figures {costs}: distance of the cost from that of the reference (above) and seconds of a warm solve "
            "(below) against the number of steps; × marks solves that failed.",
            svg(figures.routes, settings, store, scheme),
        ),
        Picture(
            f"Figures {paths}: paths with {landmark_effort.DRAWN} steps.",
            svg(figures.route_paths, settings, store, scheme),
        ),
    )
    texts = []
    count, most = settings.counts[-1], max(settings.steps)
    times = [
        (values[most]["seconds"], name)
        for (name, landmarks), values in by_route.items()
        if landmarks == count and most in values and values[most]["status"] == "solved"
    ]
    if times:
        fastest, slowest = min(times), max(times)
        texts.append(
            f"With nc = {count} and N = {most} the fastest route is {fastest[1]} "
            f"({seconds(fastest[0])}), the slowest that was run {slowest[1]} ({seconds(slowest[0])})."
        )
    # The largest difference in cost between solved routes, for Euler's methods without the routes of the action.
    spreads = []
    for landmarks in settings.counts:
        for steps in settings.steps:
            solved = [
                values[steps]["cost"]
                for (name, n), values in by_route.items()
                if n == landmarks and steps in values and values[steps]["status"] == "solved"
                and (scheme == "midpoint" or not name.startswith("action"))
            ]  # fmt: skip
            if len(solved) > 1:
                spreads.append(max(solved) - min(solved))
    if spreads:
        texts.append(f"Routes that solve the scheme's own equations agree in cost to {number(max(spreads), 2)}.")
    exact, best = figures.reference_cost(store, count), by_route[figures.STEPPING, count]
    if exact is not None and len(best) > 2:
        order = slope(list(best), [abs(v["cost"] - exact) for v in best.values()])
        texts.append(f"The error in cost falls like N to the power {number(order, 2)} (nc = {count}).")
    failed = [
        (f"{name}, nc = {landmarks}, N = {n}", v["residual"])
        for (name, landmarks), values in by_route.items()
        for n, v in values.items()
        if v["status"] != "solved"
    ]
    text = f"Solves that failed: {len(failed)}"
    if failed:
        text += f", first {failed[0][0]}"
        residuals = [residual for _, residual in failed if residual is not None]
        if residuals:
            text += f"; they stopped with residuals from {number(min(residuals), 2)} to {number(max(residuals), 2)}"
    return Section(title, (*texts, f"{text}."), (table,), pictures)


def _time_or_reach(values: dict[int, Values], steps: int) -> str:
    """Return the time of the solve with `steps` steps as text, else the largest N in `values` with its time."""
    if steps in values:
        failed = values[steps]["status"] != "solved"
        return seconds(values[steps]["seconds"]) + (" (failed)" if failed else "")
    if not values:
        return "not run"
    last = max(values)
    return f"N ≤ {last}: {seconds(values[last]['seconds'])}"


def _best(settings: Settings, store: Store) -> Section:
    texts = []
    for count in settings.counts:
        midpoint, euler = (_stepping(store, scheme, count, 100) for scheme in ("midpoint", "explicit-euler"))
        if midpoint is not None and euler is not None:
            ratio = number(midpoint["seconds"] / euler["seconds"], 2)
            texts.append(f"nc = {count}, N = 100: midpoint stepping takes {ratio} times as long as explicit Euler.")
    picture = Picture(
        "Figures 5.14–5.16: stepping by explicit Euler, by the midpoint rule, and by scipy's LSODA, whose "
        "own steps do not depend on N.",
        svg(figures.best_of_each, settings, store),
    )
    return Section("5.3 The best of each", tuple(texts), (), (picture,))


def _forty(store: Store) -> Section:
    reference = store.get(landmark_effort.REFERENCES, "nc 40") or {}
    exact, rows = reference["cost"], []
    for row in landmark_effort.ROWS:
        values = store.get(landmark_effort.TABLE, f"{row}; nc 40")
        if values is not None:
            time, error = landmark_effort.THESIS_TABLE.get(row, (None, None))
            rows.append((
                row, number(time, 4), seconds(values["seconds"]),
                number(None if time is None else time / values["seconds"], 2), number(error, 4),
                number(abs(values["cost"] - exact), 4), values["status"],
            ))  # fmt: skip
    head = ("scheme", "thesis, s", "here", "thesis/here", "error in cost, thesis", "error in cost, here", "status")
    table = Table(
        f"Table 5.2 redone: forty landmarks, N = 10. The reference, dop853 at {landmark_effort.EXACT:g}, has cost "
        f"{exact:.12f} and keeps H to {number(reference['drift'], 1)}.",
        head,
        tuple(rows),
    )
    text = (
        "The thesis's forty landmarks are not published; these are homologous points of two trilobites, so that errors "
        "may be compared in order of magnitude only, and times were taken on machines twenty years apart."
    )
    picture = Picture("Figure 5.18: the reference's paths, magnified.", svg(figures.forty, store))
    return Section("Forty landmarks", (text,), (table,), (picture,))


def _tolerances(store: Store) -> Section:
    exact = figures.reference_cost(store, 40)
    texts = []
    for code in ("lsoda", "dop853"):
        rows = [
            v for name, v in store.rows(landmark_effort.TOLERANCES) if name.startswith(code) and v["cost"] is not None
        ]
        loose = [v for v in rows if v["tolerance"] >= 0.99e-6]
        if not loose:
            continue
        worst = max(loose, key=lambda v: abs(v["cost"] - exact))
        error = abs(worst["cost"] - exact)
        comparison = "stays below" if error <= 4e-6 else "exceeds"
        texts.append(
            f"{code}: over tolerances from 1e-2 to 1e-6 the error in cost {comparison} the thesis's 4·10⁻⁶; the worst "
            f"is {number(error)} at {worst['tolerance']:g}."
        )
        tight = min(rows, key=lambda v: float(v["tolerance"]))
        texts.append(
            f"At {tight['tolerance']:g} it is {number(abs(tight['cost'] - exact), 2)}, in {seconds(tight['seconds'])}. "
            f"{sum(v['status'] != 'solved' for v in rows)} of {len(rows)} solves did not arrive within tolerance."
        )
    picture = Picture(
        "Figure 5.17: error in cost and seconds against the tolerance; crosses did not arrive.",
        svg(figures.tolerance_sweep, store),
    )
    return Section("Tolerance of the adaptive codes", tuple(texts), (), (picture,))
