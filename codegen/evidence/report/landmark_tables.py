"""Tables 5.1 and 5.2 and the figures of chapter 5, with what was measured said in sentences."""

from __future__ import annotations

from functools import partial

from codegen.evidence.report import landmark_effort
from codegen.evidence.report import landmark_figures as figures
from codegen.evidence.report.page import Picture, Section, Table, listed, number, seconds, slope
from codegen.evidence.report.settings import Settings
from codegen.evidence.report.store import Store, Values

THESIS_TIMES = {
    3: (157.5, 381.0, 1.705, 41.80),
    4: (831.6, 786.6, 2.974, 79.81),
    5: (7345.0, 1543.0, 4.663, 205.4),
}
"""Seconds of Table 5.1 at N = 100: optimal control, full solve, stepping by fsolve and by fmin."""
_TABLE_ROUTES = ("action, slsqp", "full, fsolve", "stepping, fsolve", "stepping, fmin")
_OURS = ("action, newton", "full, newton", "stepping, newton")


def sections(settings: Settings, store: Store) -> list[Section]:
    """Everything that the thesis shows in chapter 5."""
    texts, steps = [], max(settings.steps)
    for count in settings.counts:
        exact = (store.get(landmark_effort.REFERENCES, f"nc {count}") or {}).get("cost")
        found = {}
        for scheme in ("explicit-euler", "symplectic-euler", "implicit-euler"):
            values = store.get(
                landmark_effort.ROUTES_SECTION, landmark_effort.case_name(scheme, "stepping, newton", count, steps)
            )
            if values is not None and exact is not None and values["status"] == "solved":
                found[scheme] = abs(values["cost"] - exact)
        if len(found) > 1:
            least, most = min(found, key=found.__getitem__), max(found, key=found.__getitem__)
            ratio = found[most] / max(found[least], 1e-300)
            word = "close to each other" if ratio < 3.0 else "not close to each other"
            errors = listed([f"{name} {number(error)}" for name, error in found.items()])
            texts.append(f"nc = {count}, N = {steps}: errors {errors}; they are {word}, the best being {least}.")
    picture = Picture(
        "Errors in cost of the Euler methods, whose figures the thesis omits, and of the midpoint rule.",
        figures.svg(partial(figures.eulers, settings, store)),
    )
    return [
        _points(settings),
        _routes(settings, store, "explicit-euler", "5.1 Explicit Euler", "5.2–5.4", "5.5–5.7"),
        Section("Symplectic and implicit Euler methods", tuple(texts), (), (picture,)),
        _routes(settings, store, "midpoint", "5.2 Midpoint rule", "5.8–5.10", "5.11–5.13"),
        _best(settings, store),
        _forty(store),
        _tolerances(store),
    ]


def _points(settings: Settings) -> Section:
    text = (
        "Random landmarks as in the thesis's initialisation (E.3.6), drawn anew because Matlab's random numbers are "
        "not available: costs therefore differ from the thesis's, orders and routes may be compared."
    )
    picture = Picture(
        "Figure 5.1: landmarks (× start, • end) and the curved paths from which iterations start.",
        figures.svg(partial(figures.landmarks, settings)),
    )
    return Section("Control points and initial paths", (text,), (), (picture,))


def _routes(settings: Settings, store: Store, scheme: str, title: str, costs: str, paths: str) -> Section:
    tables = (_table_one(settings, store),) if scheme == "explicit-euler" else (_reach(settings, store, scheme),)
    pictures = (
        Picture(
            f"Figures {costs}: distance of the cost from that of the reference (above) and seconds of a warm solve "
            "(below) against the number of steps; × marks solves that failed.",
            figures.svg(partial(figures.routes, settings, store, scheme)),
        ),
        Picture(
            f"Figures {paths}: paths with {landmark_effort.DRAWN} steps.",
            figures.svg(partial(figures.route_paths, settings, store, scheme)),
        ),
    )
    return Section(title, tuple(_route_texts(settings, store, scheme)), tables, pictures)


def _route_texts(settings: Settings, store: Store, scheme: str) -> list[str]:
    texts = []
    most = max(settings.steps)
    best = figures.of_route(settings, store, scheme, "stepping, newton", settings.counts[-1])
    rivals = {
        route.label: dict(figures.of_route(settings, store, scheme, route.label, settings.counts[-1]))
        for route in landmark_effort.ROUTES
        if scheme in route.schemes
    }
    at = [
        (values[most]["seconds"], name)
        for name, values in rivals.items()
        if most in values and values[most]["status"] == "solved"
    ]
    if at:
        fastest, slowest = min(at), max(at)
        texts.append(
            f"With nc = {settings.counts[-1]} and N = {most} the fastest route is {fastest[1]} "
            f"({seconds(fastest[0])}), the slowest that was run {slowest[1]} ({seconds(slowest[0])})."
        )
    spread = _spread(settings, store, scheme)
    if spread is not None:
        texts.append(f"Routes that solve the scheme's own equations agree in cost to {number(spread, 2)}.")
    exact = (store.get(landmark_effort.REFERENCES, f"nc {settings.counts[-1]}") or {}).get("cost")
    if exact is not None and len(best) > 2:
        order = -slope([n for n, _ in best], [abs(v["cost"] - exact) for _, v in best])
        texts.append(f"The error in cost falls like N to the power {number(-order, 2)} (nc = {settings.counts[-1]}).")
    failed = [
        (f"{route.label}, nc = {c}, N = {n}", values["residual"])
        for route in landmark_effort.ROUTES
        if scheme in route.schemes
        for c in settings.counts
        for n, values in figures.of_route(settings, store, scheme, route.label, c)
        if values["status"] != "solved"
    ]
    texts.append(f"Solves that failed: {len(failed)}" + ("." if not failed else _failures(failed)))
    return texts


def _failures(failed: list[tuple[str, float | None]]) -> str:
    """The first of them, and how far from solved they stopped."""
    residuals = [residual for _, residual in failed if residual is not None]
    reach = f"; they stopped with residuals from {number(min(residuals), 2)} to {number(max(residuals), 2)}"
    return f", first {failed[0][0]}{reach if residuals else ''}."


def _spread(settings: Settings, store: Store, scheme: str) -> float | None:
    """The largest difference in cost between solved routes of stepping and full kind."""
    worst = None
    for count in settings.counts:
        for steps in settings.steps:
            costs = []
            for route in landmark_effort.ROUTES:
                values = store.get(
                    landmark_effort.ROUTES_SECTION, landmark_effort.case_name(scheme, route.label, count, steps)
                )
                own = route.method != "action" or scheme == "midpoint"
                if values is not None and values["status"] == "solved" and own:
                    costs.append(values["cost"])
            if len(costs) > 1:
                worst = max(worst or 0.0, max(costs) - min(costs))
    return worst


def _table_one(settings: Settings, store: Store) -> Table:
    rows = []
    for count in settings.counts:
        ours = {
            name: dict(figures.of_route(settings, store, "explicit-euler", name, count))
            for name in (*_TABLE_ROUTES, *_OURS)
        }
        cells = [str(count)]
        for name, theirs in zip(_TABLE_ROUTES, THESIS_TIMES[count], strict=True):
            found = ours[name].get(100)
            cells.append(f"{number(theirs, 4)} s")
            cells.append(_time_or_reach(ours[name], 100) if found is None else seconds(found["seconds"]))
        cells += [_time_or_reach(ours[name], 100) for name in _OURS]
        rows.append(tuple(cells))
    head = ["nc"]
    for name in ("optimal control", "full", "stepping fsolve", "stepping fmin"):
        head += [f"{name}, thesis", "here"]
    names = tuple(f"{name} (generated)" for name in _OURS)
    return Table(
        "Table 5.1 redone: seconds of explicit Euler, N = 100, the thesis's beside ours (SLSQP for fmincon, MINPACK "
        "for fsolve, Nelder and Mead for fminsearch, all on generated derivatives). “N ≤” tells how far a "
        "route was taken within the time allowed.",
        (*head, *names),
        tuple(rows),
    )


def _time_or_reach(values: dict[int, Values], steps: int) -> str:
    if steps in values:
        failed = values[steps]["status"] != "solved"
        return seconds(values[steps]["seconds"]) + (" (failed)" if failed else "")
    if not values:
        return "not run"
    last = max(values)
    return f"N ≤ {last}: {seconds(values[last]['seconds'])}"


def _reach(settings: Settings, store: Store, scheme: str) -> Table:
    names = [route.label for route in landmark_effort.ROUTES if scheme in route.schemes]
    rows = []
    for count in settings.counts:
        found = [dict(figures.of_route(settings, store, scheme, name, count)) for name in names]
        rows.append((str(count), *(_time_or_reach(values, max(settings.steps)) for values in found)))
    return Table(f"Seconds with N = {max(settings.steps)}", ("nc", *names), tuple(rows))


def _best(settings: Settings, store: Store) -> Section:
    texts = []
    for count in settings.counts:
        rows = [
            store.get(landmark_effort.ROUTES_SECTION, landmark_effort.case_name(s, "stepping, newton", count, 100))
            for s in ("midpoint", "explicit-euler")
        ]
        if all(row is not None for row in rows):
            ratio = rows[0]["seconds"] / rows[1]["seconds"]  # type: ignore[index]
            texts.append(
                f"nc = {count}, N = 100: midpoint stepping takes {number(ratio, 2)} times as long as explicit Euler."
            )
    picture = Picture(
        "Figures 5.14–5.16: stepping by explicit Euler, by the midpoint rule, and by scipy's LSODA, whose "
        "own steps do not depend on N.",
        figures.svg(partial(figures.best_of_each, settings, store)),
    )
    return Section("5.3 The best of each", tuple(texts), (), (picture,))


def _forty(store: Store) -> Section:
    reference = store.get(landmark_effort.REFERENCES, "nc 40") or {}
    exact, rows = reference["cost"], []
    for row in landmark_effort.ROWS:
        values = store.get(landmark_effort.TABLE, f"{row}; nc 40")
        if values is None:
            continue
        time, error = landmark_effort.THESIS_TABLE.get(row, (None, None))
        ours = abs(values["cost"] - exact)
        gain = "–" if time is None else number(time / values["seconds"], 2)
        rows.append(
            (
                row,
                number(time, 4),
                seconds(values["seconds"]),
                gain,
                number(error, 4),
                number(ours, 4),
                values["status"],
            )
        )
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
    picture = Picture("Figure 5.18: the reference's paths, magnified.", figures.svg(partial(figures.forty, store)))
    return Section("Forty landmarks", (text,), (table,), (picture,))


def _tolerances(store: Store) -> Section:
    exact = (store.get(landmark_effort.REFERENCES, "nc 40") or {})["cost"]
    texts = []
    for code in ("lsoda", "dop853"):
        rows = [
            v for name, v in store.rows(landmark_effort.TOLERANCES) if name.startswith(code) and v["cost"] is not None
        ]
        range_ = [v for v in rows if v["tolerance"] >= 0.99e-6]
        if not range_:
            continue
        worst = max(range_, key=lambda v: abs(v["cost"] - exact))
        error = abs(worst["cost"] - exact)
        verdict = "stays below" if error <= 4e-6 else "exceeds"
        texts.append(
            f"{code}: over tolerances from 1e-2 to 1e-6 the error in cost {verdict} the thesis's 4·10⁻⁶; the worst is "
            f"{number(error)} at {worst['tolerance']:g}."
        )
        tight = min(rows, key=lambda v: float(v["tolerance"]))
        texts.append(
            f"At {tight['tolerance']:g} it is {number(abs(tight['cost'] - exact), 2)}, in {seconds(tight['seconds'])}. "
            f"{sum(v['status'] != 'solved' for v in rows)} of {len(rows)} solves did not arrive within tolerance."
        )
    picture = Picture(
        "Figure 5.17: error in cost and seconds against the tolerance; crosses did not arrive.",
        figures.svg(partial(figures.tolerance_sweep, store)),
    )
    return Section("Tolerance of the adaptive codes", tuple(texts), (), (picture,))
