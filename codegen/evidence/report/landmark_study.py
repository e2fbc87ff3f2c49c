"""The study of landmark registration: measure missing cases, then write page, CSV and JSON.

The first sections of the page repeat Tables 5.1 and 5.2 and the figures of chapter 5 of the thesis, with conclusions
from the measured values. Sections on the open questions of chapter 6 follow, each answered by measurements.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from codegen.evidence.report import landmark_cases
from codegen.evidence.report import landmark_figures as figures
from codegen.evidence.report.landmark_cases import LOOSE, TIGHT, Minimisation
from codegen.evidence.report.page import Picture, Section, Table, listed, number, page, seconds, slope, svg
from codegen.evidence.report.store import Case, Settings, Store, Values
from codegen.files import write_text
from codegen.machine import machine
from codegen.terminal import progress

PARTS: tuple[tuple[str, Callable[[Settings, Store], Iterator[Case]]], ...] = (
    ("accuracy", landmark_cases.accuracy_cases),
    ("routes", landmark_cases.route_cases),
    ("fastest", landmark_cases.fastest_cases),
    ("initial paths", landmark_cases.path_cases),
    ("midpoint", landmark_cases.midpoint_cases),
    ("dimension", landmark_cases.dimension_cases),
    ("smoothness", landmark_cases.smoothness_cases),
    ("weak solution", landmark_cases.weak_solution_cases),
    ("jumps", landmark_cases.jump_cases),
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
    questions = [] if settings.quick else [
        _paths(settings, store), _dimension(store), _smoothness(store), _jumps(settings, store),
        _midpoint(settings, store), _orders(store), _ansatz(store),
    ]  # fmt: skip
    return [
        Section("Control points and initial paths", (text,), (), (points,)),
        _routes(settings, store, "explicit-euler", "5.1 Explicit Euler", "5.2–5.4", "5.5–5.7"),
        _eulers(settings, store),
        _routes(settings, store, "midpoint", "5.2 Midpoint rule", "5.8–5.10", "5.11–5.13"),
        Section("5.3 The best of each", tuple(texts), (), (picture,)),
        _forty(store),
        _tolerances(store),
        *questions,
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
    name = landmark_cases.case_name(scheme, figures.STEPPING, count, steps)
    return store.get(landmark_cases.ROUTES_SECTION, name)


def _routes(settings: Settings, store: Store, scheme: str, title: str, costs: str, paths: str) -> Section:
    """Return the section on the routes of a scheme; `costs` and `paths` are numbers of figures in the thesis."""
    by_route = {
        (route.label, count): dict(figures.by_route(settings, store, scheme, route.label, count))
        for route in landmark_cases.routes_of(scheme)
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
            f"Figures {paths}: paths with {landmark_cases.DRAWN} steps.",
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


def _forty(store: Store) -> Section:
    reference = store.get(landmark_cases.REFERENCES, "nc 40") or {}
    exact, rows = reference["cost"], []
    for row in landmark_cases.ROWS:
        values = store.get(landmark_cases.TABLE, f"{row}; nc 40")
        if values is not None:
            time, error = landmark_cases.THESIS_TABLE.get(row, (None, None))
            rows.append((
                row, number(time, 4), seconds(values["seconds"]),
                number(None if time is None else time / values["seconds"], 2), number(error, 4),
                number(abs(values["cost"] - exact), 4), values["status"],
            ))  # fmt: skip
    head = ("scheme", "thesis, s", "here", "thesis/here", "error in cost, thesis", "error in cost, here", "status")
    table = Table(
        f"Table 5.2 redone: forty landmarks, N = 10. The reference, dop853 at {landmark_cases.EXACT:g}, has cost "
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
            v for name, v in store.rows(landmark_cases.TOLERANCES) if name.startswith(code) and v["cost"] is not None
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


# ---- The open questions of chapter 6 ----

_THESIS = Minimisation("nodes", "curved", LOOSE)  # the variant of the minimisation that the thesis uses
_JUMP = 5.0  # a jump is a growth of the error by this factor from one N to the next, while the iterations decrease


def _paths(settings: Settings, store: Store) -> Section:
    sets = [f"nc {n}" for n in (*settings.counts, 40)] + ["nc 100, smooth"]
    rows, texts = [], []
    for kind, meaning in landmark_cases.KINDS.items():
        cells, distances = [], []
        for name in sets:
            values = store.get(landmark_cases.PATHS_SECTION, f"{kind}; {name}")
            if values is None:
                cells.append("–")
                continue
            cells.append(f"{values['iterations']}" if values["solved"] else f"fails ({values['iterations']})")
            if values["distance of places"] is not None:
                distances.append(values["distance of places"])
        rows.append((meaning, *cells, number(max(distances, default=None), 2)))
    for name in sets:
        by_kind = {kind: store.get(landmark_cases.PATHS_SECTION, f"{kind}; {name}") for kind in landmark_cases.KINDS}
        solved = {kind: v["iterations"] for kind, v in by_kind.items() if v is not None and v["solved"]}
        failed = [kind for kind, v in by_kind.items() if v is not None and not v["solved"]]
        if not solved:
            texts.append(f"{name}: no guess leads to a solution.")
            continue
        least, curved = min(solved.values()), solved.get("curved")
        best = listed([kind for kind, iterations in solved.items() if iterations == least])
        comparison = "the curved path fails"
        if curved is not None:
            comparison = "the curved path needs as few" if curved == least else f"the curved path needs {curved}"
        failures = f"; from {listed(failed)} there is no convergence." if failed else "."
        texts.append(f"{name}: fewest iterations, {least}, from {best}; {comparison}{failures}")
    table = Table(
        f"Iterations of Newton's method for all states at once, explicit Euler, N = {landmark_cases.PATHS_STEPS}, and "
        "how far the guessed places are from the solution at most.",
        ("initial path", *sets, "distance"),
        tuple(rows),
    )
    return Section("Question 1: can better initial paths be generated?", tuple(texts), (table,))


def _dimension(store: Store) -> Section:
    lines, texts, rows = figures.by_kernel(store), [], []
    for name, line in lines.items():
        large = [(n, v) for n, v in line if n >= 20]
        exponents = [
            slope([n for n, _ in large], [v[key] for _, v in large]) for key in ("seconds of a trajectory", "seconds")
        ]
        count, last = line[-1]
        rows.append((
            name, str(last["operations"][1]), str(count), seconds(last["seconds of a trajectory"]),
            seconds(last["seconds"]), *(number(exponent, 2) for exponent in exponents),
        ))  # fmt: skip
    for kernel in ("gauss", "plate"):
        pair = [lines[name] for name in (f"{kernel} 2-D", f"{kernel} 3-D") if name in lines]
        if len(pair) == 2:
            count = min(line[-1][0] for line in pair)
            times = [dict(line)[count]["seconds of a trajectory"] for line in pair]
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
        svg(figures.dimension_figure, store),
    )
    title = "Question 2: how do the methods scale with the dimension of space?"
    return Section(title, tuple(texts), (table,), (picture,))


def _smoothness(store: Store) -> Section:
    texts, rows = [], []
    for amplitude in landmark_cases.AMPLITUDES:
        warps = figures.warps(store, amplitude)
        if not warps:
            texts.append(f"Displacements × {amplitude:g}: too few of the warps were solved.")
            continue
        fine = [v for v in warps if v["steps"] >= 5]
        order = -slope([v["steps"] for v in fine], [v["error"] for v in fine])
        steps = [next((v["steps"] for v in warps if v["error"] <= limit), None) for limit in (1e-2, 1e-3)]
        folded = [str(v["steps"]) for v in warps if v["least area"] <= 0.0]
        rows.append((
            f"× {amplitude:g}", number(warps[0]["exact least area"], 3),
            *("> 80" if n is None else str(n) for n in steps), listed(folded),
            number(warps[-1]["steepest"] * warps[-1]["steps"], 3), number(order, 2),
        ))  # fmt: skip
        if folded and len(folded) < len(warps):
            texts.append(f"Displacements × {amplitude:g} fold the grid with N = {listed(folded)}.")
    if rows:
        needs = "; ".join(f"{row[0]} need N = {row[2]} for an error of 1e-2 and {row[3]} for 1e-3" for row in rows)
        folds = "No warp folds." if all(row[4] == "none" for row in rows) else "Some warps fold."
        texts.append(f"Displacements {needs}. {folds}")
    texts.append(
        "A single explicit step is one to one where h times the Lipschitz constant of v is below one; the constant "
        "that was measured tells how many steps guarantee it."
    )
    table = Table(
        "The trilobites' landmarks with displacements multiplied, explicit Euler; the warp of a grid of the disc "
        "against that with 640 steps.",
        ("displacements", "least area, exact", "N for error 1e-2", "N for error 1e-3", "N that fold",
         "Lipschitz constant", "order"),
        tuple(rows),
    )  # fmt: skip
    picture = Picture(
        "Error of the warp, and the least ratio by which areas change (dotted: with 640 steps); below zero there is "
        "a fold.",
        svg(figures.smoothness_figure, store),
    )
    title = "Question 3: how many steps does a warp of given smoothness need?"
    return Section(title, tuple(texts), (table,), (picture,))


def _jumps(settings: Settings, store: Store) -> Section:
    texts, rows = [], []
    for count in settings.counts[:2]:
        null = store.get(landmark_cases.JUMPS_SECTION, f"null space; nc {count}")
        if null is not None:
            texts.append(
                f"nc = {count}: with momenta on nodes, {null['nodes']} directions of the unknowns change neither the "
                f"cost nor a constraint; with momenta on intervals, {null['intervals']}."
            )
        by_variant = {
            variant: line
            for variant in landmark_cases.VARIANTS
            if (line := figures.by_variant(settings, store, variant, count))
        }
        for variant, line in by_variant.items():
            errors = [v["error"] for _, v in line]
            rows.append((
                f"nc {count}, {variant.momenta}, {variant.path}, {variant.tolerance:.0e}", str(line[-1][0]),
                number(min(errors), 2), number(max(errors), 2), number(max(v["constraints"] for _, v in line), 2),
                number(max(v["stationarity"] for _, v in line), 2), _range([v["iterations"] for _, v in line], "–"),
                number(max(v["alternating"] for _, v in line), 2),
            ))  # fmt: skip
        texts += _conclusions(count, by_variant)
    table = Table(
        "Midpoint rule as a minimisation by SLSQP: error of its cost against Newton's minimum of the same discrete "
        "problem, largest residuals where it stopped, iterations, and the largest alternating part of nodal momenta.",
        ("variant", "N up to", "least error", "largest error", "constraints", "stationarity", "iterations",
         "alternating part"),
        tuple(rows),
    )  # fmt: skip
    picture = Picture(
        "Error and time of SLSQP: red with momenta on nodes as in the thesis, blue on intervals; full lines from "
        "curved and dotted ones from straight paths at tolerance 1e-6, dashes at 1e-14.",
        svg(figures.jump_figure, settings, store),
    )
    title = "Question 4: what happens inside the optimiser in Figures 5.8 and 5.9?"
    return Section(title, tuple(texts), (table,), (picture,))


def _conclusions(count: int, by_variant: dict[Minimisation, figures.Rows]) -> list[str]:
    """Return conclusions on tolerances, momenta and initial paths, for the set of `count` landmarks."""
    worst = {variant: max(v["error"] for _, v in line) for variant, line in by_variant.items()}
    loose = max((error for variant, error in worst.items() if variant.tolerance == LOOSE), default=None)
    tight = max((error for variant, error in worst.items() if variant.tolerance == TIGHT), default=None)
    if loose is None or tight is None:
        return []
    texts = []
    if loose > 100.0 * tight:
        texts.append(
            f"nc = {count}: at tolerance 1e-6 the optimiser stops early, up to {number(loose, 2)} from the "
            f"minimum; at 1e-14 within {number(tight, 2)}: errors of this kind come from the tolerance."
        )
    else:
        texts.append(
            f"nc = {count}: the tolerance does not decide: errors are up to {number(loose, 2)} at 1e-6 and up to "
            f"{number(tight, 2)} at 1e-14."
        )
    with_jumps, without, early = [], [], list[int]()
    for variant, line in by_variant.items():
        name = f"momenta on {variant.momenta}, {variant.path} paths, {variant.tolerance:g}"
        jumps = [
            (n, v["iterations"])
            for (n, v), (_, before) in zip(line[1:], line[:-1], strict=True)
            if v["error"] > _JUMP * max(before["error"], 1e-12) and v["iterations"] < before["iterations"]
        ]
        if variant == _THESIS:
            early = [iterations for _, iterations in jumps]
        if jumps:
            with_jumps.append(f"{name} at N = {listed([str(n) for n, _ in jumps])}")
        else:
            without.append(name)
    outcome = "are reproduced" if early else "are not reproduced as far as N went"
    texts.append(
        f"nc = {count}: the thesis's jumps to faster and less accurate solves {outcome}. The error grows by a factor "
        f"of {_JUMP:g} or more from one N to the next as iterations fall: {'; '.join(with_jumps) or 'nowhere'}. "
        f"No such jump: {'; '.join(without) or 'nowhere'}."
    )
    if early:
        texts.append(
            f"At these N the optimiser, started from the curved paths, is content after {_range(early, ' to ')} "
            "iterations, because the cost then changes by less than the tolerance though it is not stationary."
        )
    return texts


def _range(numbers: Sequence[int], separator: str) -> str:
    least, largest = min(numbers), max(numbers)
    return f"{least}" if least == largest else f"{least}{separator}{largest}"


def _midpoint(settings: Settings, store: Store) -> Section:
    texts, rows = [], []
    for count in (*settings.counts, 40):
        generated = store.get(landmark_cases.MIDPOINT_SECTION, f"generated; nc {count}")
        nested = store.get(landmark_cases.MIDPOINT_SECTION, f"nested fsolve; nc {count}")
        if generated is None:
            continue
        ratio = generated["midpoint seconds"] / generated["explicit-euler seconds"]
        rows.append((
            str(count), seconds(generated["midpoint seconds"]), seconds(generated["explicit-euler seconds"]),
            number(ratio, 2), number(generated["midpoint trajectory"] / generated["explicit-euler trajectory"], 2),
            seconds(nested["seconds"]) if nested else "–",
            number(nested["seconds"] / generated["midpoint seconds"] if nested else None, 2),
        ))  # fmt: skip
        if count == 40:
            thesis = landmark_cases.THESIS_TABLE["midpoint"][0] / landmark_cases.THESIS_TABLE["explicit-euler"][0]
            texts.append(
                f"Forty landmarks, N = 10: midpoint stepping takes {number(ratio, 2)} times as long as explicit Euler, "
                f"{'less' if ratio < thesis else 'more'} than the thesis's {number(thesis, 3)}."
            )
    table = Table(
        "Processor time of midpoint stepping, N = 10. Newton's method with generated derivatives solves each step and "
        "finds the initial momenta. The thesis nests two root finders with finite differences.",
        ("nc", "midpoint", "explicit Euler", "ratio", "ratio of trajectories", "nested fsolve, as in the thesis",
         "its time / ours"),
        tuple(rows),
    )  # fmt: skip
    return Section("Question 5: can midpoint stepping be made efficient?", tuple(texts), (table,))


def _orders(store: Store) -> Section:
    exact = figures.reference_cost(store, 40)
    rows = []
    for scheme in landmark_cases.SCHEMES:
        runs = [
            v for name, v in store.rows(landmark_cases.WORK)
            if name.startswith(f"{scheme};") and v["status"] == "solved"
        ]  # fmt: skip
        if not runs:
            continue
        errors = [abs(v["cost"] - exact) for v in runs]
        points = [(v["steps"], error) for v, error in zip(runs, errors, strict=True) if error > 1e-11]
        order = -slope([n for n, _ in points], [error for _, error in points])
        cells = [f"{number(error, 2)} in {seconds(v['seconds'])}" for v, error in zip(runs, errors, strict=True)]
        rows.append((scheme, *cells, number(order, 2)))
    most = max((len(row) for row in rows), default=2)
    padded = tuple((*row[:-1], *["–"] * (most - len(row)), row[-1]) for row in rows)
    head = ("scheme", *(f"N = {n}" for n in (5, 10, 20, 40, 80)[: most - 2]), "order")
    table = Table("Error in cost and seconds on forty landmarks, compiled.", head, padded)
    picture = Picture(
        "Error against time on forty landmarks; crosses: adaptive codes of scipy at the tolerances of the sweep.",
        svg(figures.work_and_precision, store),
    )
    # The fastest scheme for each error, compared with explicit Euler, midpoint and DOP853.
    texts, columns = [], []
    schemes = (*landmark_cases.STEPPED, *landmark_cases.ADAPTIVE)
    for target in landmark_cases.TARGETS:
        results = {s: store.get(landmark_cases.FASTEST_SECTION, f"{s}; {target:g}") for s in schemes}
        reached = {scheme: v for scheme, v in results.items() if v is not None and v["reached"]}
        columns.append({s: f"{v['steps']} in {seconds(v['seconds'])}" for s, v in reached.items()})
        if not reached:
            continue
        best = min(reached, key=lambda scheme: reached[scheme]["seconds"])
        time, comparisons = reached[best]["seconds"], []
        for scheme in ("explicit-euler", "midpoint", "dop853"):
            if scheme not in reached:
                comparisons.append(f"{scheme} does not get there")
            elif scheme != best:
                comparisons.append(f"{scheme} takes {number(reached[scheme]['seconds'] / time, 2)} times as long")
        texts.append(
            f"Error below {target:g}: {best} with {reached[best]['steps']} steps, in {seconds(time)}; "
            f"{listed(comparisons)}."
        )
    fastest = Table(
        "Fewest steps, or loosest tolerance of four a decade, that meet an error in cost on forty landmarks, and wall-"
        "clock time; a dash where 3000 steps do not suffice.",
        ("scheme", *(f"{target:g}" for target in landmark_cases.TARGETS)),
        tuple((s, *(column.get(s, "–") for column in columns)) for s in schemes),
    )
    return Section("Question 6: do higher orders pay, compiled?", tuple(texts), (fastest, table), (picture,))


def _ansatz(store: Store) -> Section:
    measured = list(store.rows(landmark_cases.WEAK_SOLUTION_SECTION))
    rows = [(name, number(v["largest defect"], 2), number(v["largest rate"], 2)) for name, v in measured]
    worst = max((v["largest defect"] / v["largest rate"] for _, v in measured), default=1.0)
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
