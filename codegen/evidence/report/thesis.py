"""Experiments of the thesis on some problems of the gallery: further modules, cases and sections.

Figures 3.3 to 3.9 of the thesis: the orbital transfer by midpoint and Euler, checked by a Runge-Kutta code. The method
R-K interpolates the optimal force of the midpoint rule by a cubic spline and integrates the forced equations with it;
where that motion ends, it should meet the target orbit. Its miss distance is an error that no part of the generated
code had a hand in.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline

from codegen.evidence.report import landmark_study
from codegen.evidence.report.building import SURVEYS, Variant, Workshop
from codegen.evidence.report.landmark_figures import svg
from codegen.evidence.report.optima import solved
from codegen.evidence.report.orders import measured_order, order_text
from codegen.evidence.report.page import Picture, Section, Table, number, seconds
from codegen.evidence.report.problem_figures import colour_of
from codegen.evidence.report.settings import Extent, quick_settings
from codegen.evidence.report.store import Case, Store, Values
from codegen.show.figures.picture import BLUE, CRIMSON, DARK, GREEN, GREY, RED, body_colours
from codegen.solving.interfaces import ControlModule, is_control, is_simulation

HOVERCRAFT_SECTION = "hovercraft: figures A.1 to A.5"
CRAFT = (3, 5)
HOVERCRAFT_STEPS = 20


def hovercraft_variants(problem: Path) -> list[Variant]:
    """A module for three craft, and one for five."""
    return [Variant(problem, "variational", "midpoint", 2, (("craft", str(count)),)) for count in CRAFT]


def hovercraft_cases(problem: Path, workshop: Workshop, extent: Extent) -> Iterator[Case]:
    """A case for each number of craft."""
    for variant, count in zip(hovercraft_variants(problem), CRAFT, strict=True):
        yield Case(HOVERCRAFT_SECTION, f"{count} craft", lambda v=variant: _solved(workshop, v, extent.repeat))  # type: ignore[misc]


def _solved(workshop: Workshop, variant: Variant, repeat: int) -> Values:
    module = workshop.module(variant)
    assert is_control(module)
    grid = module.make_grid(HOVERCRAFT_STEPS)
    _, guess, *_ = module.unpack(grid, module.initial_guess(grid))
    optimum = module.solve(HOVERCRAFT_STEPS).q
    bodies = module.metadata.bodies
    values = solved(module, HOVERCRAFT_STEPS, repeat)
    return {
        **values,
        "guess": guess.reshape(HOVERCRAFT_STEPS + 1, bodies, 3),
        "optimum": optimum.reshape(HOVERCRAFT_STEPS + 1, bodies, 3),
    }


def hovercraft_sections(store: Store, problem: Path) -> list[Section]:
    """A table and the paths."""
    del problem
    found = {count: store.get(HOVERCRAFT_SECTION, f"{count} craft") for count in CRAFT}
    known = {count: values for count, values in found.items() if values is not None}
    if not known:
        return []
    rows = tuple(
        (str(count), v["status"], f"{v['cost']:.9g}", seconds(v["seconds"]), str(v["iterations"]),
         number(v["residual"], 2), number(v["stationarity"], 2))
        for count, v in known.items()
    )  # fmt: skip
    head = ("craft", "status", "cost", "time", "iterations", "residual", "stationarity")
    table = Table(f"Hovercraft on N = {HOVERCRAFT_STEPS} intervals.", head, rows)
    picture = Picture(
        "First guess (left) and optimum (right); arrows show the heading at every other node.",
        svg(lambda: paths(known)),
    )
    return [Section("Hovercraft: Figures A.1 to A.5", (), (table,), (picture,))]


def paths(known: dict[int, Values]) -> Figure:
    """A row for each number of craft."""
    figure = Figure(figsize=(8.6, 4.3 * len(known)), layout="constrained")
    axes = figure.subplots(len(known), 2, squeeze=False, sharex="row", sharey="row")
    for row, (count, values) in zip(axes, known.items(), strict=True):
        for place, name in zip(row, ("guess", "optimum"), strict=True):
            _draw(place, np.array(values[name], dtype=float))
            place.set(aspect="equal", xlabel="$x$", title=f"{count} craft, {name}")
        row[0].set_ylabel("$y$")
    return figure


def _draw(axes: Any, states: Any) -> None:
    """Paths with headings, and the polygon in which they end; states of shape (N + 1, craft, 3)."""
    ends = states[-1, :, :2]
    axes.plot(*np.vstack([ends, ends[:1]]).T, color=GREY, linewidth=0.8)
    for body, colour in enumerate(body_colours(states.shape[1], "")):
        x, y, heading = states[:, body].T
        axes.plot(x, y, color=colour)
        axes.plot(x[0], y[0], "x", color=colour, markersize=5)
        axes.plot(x[-1], y[-1], "o", color=colour, markersize=4)
        axes.quiver(x[::2], y[::2], np.cos(heading[::2]), np.sin(heading[::2]), color=CRIMSON, angles="xy",
                    scale=14, width=0.004, headwidth=4)  # fmt: skip


def landmark_variants(problem: Path) -> list[Variant]:
    """None: the study makes its modules when it needs them, of several schemes, methods and kernels."""
    del problem
    return []


def landmark_cases(problem: Path, workshop: Workshop, extent: Extent) -> Iterator[Case]:
    """What the quick form of the study measures, whatever the extent: the whole one takes longer than all the rest."""
    del extent
    for _, part in landmark_study.PARTS:
        yield from part(quick_settings(problem), workshop.store)


def landmark_sections(store: Store, problem: Path) -> list[Section]:
    """The thesis's tables and figures of one set of few landmarks and of the trilobites."""
    reason = f"One set of few landmarks, fast routes, no open questions: codegen report {problem.name} has them all."
    return [Section(f"{problem.stem}: landmarks", (reason,)), *landmark_study.of_study(quick_settings(problem), store)]


LINEAR_SECTION = "linear_pendulum: figures 3.1 and 3.2"
LINEAR_STEPS = tuple(range(10, 201, 5))
LINEAR_METHODS = (
    ("Var.", "variational", "midpoint", 2, BLUE, "-"),
    ("Euler", "hamiltonian", "explicit-euler", 1, RED, "-"),
    ("Ham. Eq'ns", "hamiltonian", "midpoint", 2, GREEN, "--"),
)
"""The thesis's name, method, scheme, order, and how it is drawn."""


def linear_pendulum_variants(problem: Path) -> list[Variant]:
    """The modules of the three transcriptions."""
    return [Variant(problem, method, scheme, order) for _, method, scheme, order, _, _ in LINEAR_METHODS]


def linear_pendulum_cases(problem: Path, workshop: Workshop, extent: Extent) -> Iterator[Case]:
    """N = 10:5:200 for each transcription, every fourth of these in the quick form."""
    for variant, (label, *_) in zip(linear_pendulum_variants(problem), LINEAR_METHODS, strict=True):
        for steps in LINEAR_STEPS[::4] if extent.quick else LINEAR_STEPS:
            yield Case(
                LINEAR_SECTION,
                f"{label}; N {steps}",
                lambda v=variant, n=steps: _linear_solved(workshop, v, n, extent.repeat),  # type: ignore[misc]
            )


def _linear_solved(workshop: Workshop, variant: Variant, steps: int, repeat: int) -> Values:
    module = workshop.module(variant)
    assert is_control(module)
    return solved(module, steps, repeat)


def _rows(store: Store, label: str) -> list[Values]:
    return [values for name, values in store.rows(LINEAR_SECTION) if name.startswith(f"{label}; ")]


def linear_pendulum_sections(store: Store, problem: Path) -> list[Section]:
    """Cost, error and time against the number of steps."""
    exact = (store.get(SURVEYS, problem.stem) or {}).get("exact cost")
    if exact is None or not _rows(store, "Var."):
        return []
    rows = []
    for label, method, scheme, order, *_ in LINEAR_METHODS:
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
    for label, _, _, _, colour, style in LINEAR_METHODS:
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


ORBIT_SECTION = "orbital_transfer: figures 3.3 to 3.9"
ORBIT_METHODS = (("Mid.", "variational", "midpoint", 2, BLUE), ("Euler", "hamiltonian", "explicit-euler", 1, RED))
SWEEPS = {1: tuple(range(10, 51, 5)), 2: tuple(range(10, 101, 10))}
FORCES = {1: (50, 100, 150), 2: (100, 200, 300)}
"""Numbers of steps by revolutions: of Figures 3.3 and 3.4, and of Figures 3.7 to 3.9."""
TOLERANCE = 1e-11


def orbit_variants(problem: Path) -> list[Variant]:
    """The modules of both discretisations."""
    return [Variant(problem, method, scheme, order) for _, method, scheme, order, _ in ORBIT_METHODS]


def orbit_cases(problem: Path, workshop: Workshop, extent: Extent) -> Iterator[Case]:
    """Both methods for one and two revolutions; the motions of the largest N are kept."""
    for variant, (label, *_) in zip(orbit_variants(problem), ORBIT_METHODS, strict=True):
        for revolutions, sweep in SWEEPS.items():
            wanted = sorted({*(sweep[::3] if extent.quick else sweep), *FORCES[revolutions]})
            for steps in wanted:
                yield Case(
                    ORBIT_SECTION,
                    _name(label, revolutions, steps),
                    lambda v=variant, p=revolutions, n=steps: _transfer(workshop, v, p, n, extent.repeat),  # type: ignore[misc]
                )


def _name(label: str, revolutions: int, steps: int) -> str:
    return f"{label}; {revolutions} revolutions; N {steps}"


def _transfer(workshop: Workshop, variant: Variant, revolutions: int, steps: int, repeat: int) -> Values:
    """A solution, its time, and where the motion under its splined force ends."""
    module = workshop.module(variant)
    assert is_control(module)
    best = math.inf
    for _ in range(3 * repeat + 1):
        begin = time.perf_counter()
        solution = module.solve(steps, revolutions=float(revolutions))
        best = min(best, time.perf_counter() - begin)
    found: dict[str, Any] = {
        "status": solution.status, "cost": solution.cost, "seconds": best, "steps": steps,
        "iterations": solution.iterations, "residual": solution.residual,
    }  # fmt: skip
    if variant.scheme == "midpoint":
        found |= _reintegrated(module, solution, revolutions)
    if steps in FORCES[revolutions]:
        found |= {"r": solution.q[:, 0], "phi": solution.q[:, 1], "t": solution.t, "u": solution.u[:, 0]}
    return found


def _reintegrated(module: ControlModule, solution: Any, revolutions: int) -> Values:
    """R-K: m (r'' - r phi'^2) = -GM m/r^2 and (m r^2 phi')' = r u, written for r, phi and their velocities."""
    values = module.metadata.parameters
    m, gravity, r0, r1 = (values[name] for name in ("m", "GM", "r0", "r1"))
    t = solution.t
    force = CubicSpline(0.5 * (t[1:] + t[:-1]), solution.u[:, 0])

    def field(at: float, z: Any) -> list[float]:
        r, _, y, w = z
        return [y, w, r * w * w - gravity / r**2, (float(force(at)) / m - 2.0 * y * w) / r]

    start = [r0, 0.0, 0.0, math.sqrt(gravity / r0**3)]
    done = solve_ivp(field, (t[0], t[-1]), start, "DOP853", rtol=TOLERANCE, atol=TOLERANCE,
                     t_eval=np.linspace(t[0], t[-1], 201))  # fmt: skip
    r, phi, y, w = done.y[:, -1]
    angle = 2.0 * math.pi * revolutions
    place = math.hypot(r * math.cos(phi) - r1 * math.cos(angle), r * math.sin(phi) - r1 * math.sin(angle))
    velocity = math.hypot(y, r * w - r1 * math.sqrt(gravity / r1**3))
    return {"miss": place, "velocity miss": velocity, "R-K r": done.y[0], "R-K phi": done.y[1]}


def _sweep(store: Store, label: str, revolutions: int) -> list[Values]:
    names = (_name(label, revolutions, n) for n in SWEEPS[revolutions])
    return [values for name in names if (values := store.get(ORBIT_SECTION, name)) is not None]


def orbit_sections(store: Store, problem: Path) -> list[Section]:
    """Costs, times, orbits, forces and the miss of R-K."""
    del problem
    if not _sweep(store, "Mid.", 1):
        return []
    text = (
        "R-K interpolates the optimal force of Mid. by a cubic spline (controls of an interval stand at its middle) "
        "and integrates the forced equations of section 3.3, written out here by hand, by DOP853 at tolerance "
        f"{TOLERANCE:g}: where it ends should be the target, the more so the larger N. The thesis's forces "
        "alternate from step to step, since its controls stand on nodes; here they stand on intervals."
    )
    pictures = (
        Picture("Costs, times and miss of R-K (Figures 3.3 and 3.4; the miss is not in the thesis).",
                svg(lambda: costs(store))),
        Picture("Orbits of the three methods (Figures 3.5 and 3.6); grey: first and last orbit.",
                svg(lambda: orbits(store))),
        Picture("Optimal forces (Figures 3.7 to 3.9).", svg(lambda: forces(store))),
    )  # fmt: skip
    return [Section("Orbital transfer: Figures 3.3 to 3.9", (text,), (_table(store),), pictures)]


def _table(store: Store) -> Table:
    rows = []
    for revolutions in SWEEPS:
        for label, *_ in ORBIT_METHODS:
            values = _sweep(store, label, revolutions)
            last = values[-1]
            missed = [v.get("miss") for v in values]
            rows.append((
                label, str(revolutions), str(last["steps"]), f"{last['cost']:.8g}", seconds(last["seconds"]),
                str(last["iterations"]), number(last.get("miss")), number(last.get("velocity miss")),
                order_text(measured_order([v["steps"] for v in values], missed), 2),
                str(sum(v["status"] != "solved" for v in values)),
            ))  # fmt: skip
    head = ("method", "revolutions", "N", "cost", "time", "iterations", "miss of R-K", "its velocity miss",
            "order of the miss", "failed")  # fmt: skip
    return Table("The largest N of each sweep.", head, tuple(rows))


def costs(store: Store) -> Figure:
    """A row for each number of revolutions."""
    figure = Figure(figsize=(9.6, 5.4), layout="constrained")
    axes = figure.subplots(2, 3)
    for row, revolutions in zip(axes, SWEEPS, strict=True):
        for label, *_, colour in ORBIT_METHODS:
            values = [v for v in _sweep(store, label, revolutions) if v["status"] == "solved"]
            steps = [v["steps"] for v in values]
            row[0].plot(steps, [v["cost"] for v in values], "o-", markersize=3, color=colour, label=label)
            row[1].plot(steps, [1e3 * v["seconds"] for v in values], "o-", markersize=3, color=colour)
            if label == "Mid.":
                row[2].loglog(steps, [v["miss"] for v in values], "o-", markersize=3, color=DARK, label="place")
                row[2].loglog(steps, [v["velocity miss"] for v in values], "o--", markersize=3, color=GREY,
                              label="velocity")  # fmt: skip
        ticks = [n for n in (10, 20, 50, 100) if n <= SWEEPS[revolutions][-1]]
        row[2].set(xticks=ticks, xticklabels=[str(n) for n in ticks])
        row[2].minorticks_off()
        plural = "s" if revolutions > 1 else ""
        row[0].set_ylabel(f"{revolutions} revolution{plural}\ncost")
        row[1].set_ylabel("time [ms]")
        row[1].set_ylim(bottom=0.0)
        row[2].set_ylabel("miss of R-K")
    for place in axes[1]:
        place.set_xlabel("steps $N$")
    axes[0][0].legend()
    axes[0][2].legend()
    return figure


def orbits(store: Store) -> Figure:
    """Polar plots of the smallest N of the force figures."""
    figure = Figure(figsize=(8.6, 4.2), layout="constrained")
    for place, (revolutions, steps) in enumerate((p, FORCES[p][0]) for p in SWEEPS):
        axes: Any = figure.add_subplot(1, 2, place + 1, projection="polar")
        angles = np.linspace(0.0, 2.0 * np.pi, 200)
        for label, *_, colour in ORBIT_METHODS:
            values = store.get(ORBIT_SECTION, _name(label, revolutions, steps))
            if values is None:
                continue
            axes.plot(values["phi"], values["r"], color=colour, label=label)
            for radius in (values["r"][0], values["r"][-1]):
                axes.plot(angles, np.full(200, radius), color=GREY, linewidth=0.6)
            if "R-K r" in values:
                axes.plot(
                    values["R-K phi"], values["R-K r"], color=DARK, linestyle=":", label="R-K", zorder=3, linewidth=1.3
                )
        axes.set(title=f"{revolutions} revolution{'s' if revolutions > 1 else ''}, N = {steps}", rlabel_position=135)
        axes.set_rlim(0.0, 7.0)
        axes.set_rticks([5.0, 6.0])
        if place == 1:
            axes.legend(loc="center")
    return figure


def forces(store: Store) -> Figure:
    """Forces of Mid. and Euler against time."""
    figure = Figure(figsize=(9.6, 5.4), layout="constrained")
    axes = figure.subplots(2, 3, sharex="row", sharey="row")
    for row, (revolutions, counts) in zip(axes, FORCES.items(), strict=True):
        for place, steps in zip(row, counts, strict=True):
            for label, *_, colour in ORBIT_METHODS:
                values = store.get(ORBIT_SECTION, _name(label, revolutions, steps))
                if values is not None:
                    place.stairs(values["u"], values["t"], color=colour, label=label, baseline=None, linewidth=1.2)
            place.set_title(f"$p = {revolutions}$, $N = {steps}$")
        row[0].set_ylabel("force $u$")
        for place in row:
            place.set_xlabel("time")
    axes[0][0].legend()
    return figure


PENDULUM_SECTION = "pendulum: figure 1.3"
PORTRAITS = (
    ("explicit-euler", 0.2, ((0.5, 0.0),), 60),
    ("implicit-euler", 0.2, ((1.5, 0.0),), 150),
    ("symplectic-euler", 0.3, ((0.0, 0.7), (0.0, 1.4), (0.0, 2.1)), 200),
    ("midpoint", 0.3, ((0.0, 0.7), (0.0, 1.4), (0.0, 2.1)), 200),
)
"""Scheme, step, initial states and number of steps, which the thesis does not give."""
LONG = 100_000
"""Steps after which the drift of energy is measured again."""


def pendulum_variants(problem: Path) -> list[Variant]:
    """The modules that the portraits need."""
    return [Variant(problem, "hamiltonian", scheme, 2 if scheme == "midpoint" else 1) for scheme, *_ in PORTRAITS]


def pendulum_cases(problem: Path, workshop: Workshop, extent: Extent) -> Iterator[Case]:
    """A case for every method and initial state."""
    del extent
    for variant, (scheme, h, starts, steps) in zip(pendulum_variants(problem), PORTRAITS, strict=True):
        for start in starts:
            yield Case(
                PENDULUM_SECTION,
                f"{scheme}; {start}",
                lambda v=variant, h=h, z=start, n=steps: _path(workshop, v, h, z, n),  # type: ignore[misc]
            )


def _path(workshop: Workshop, variant: Variant, h: float, start: tuple[float, float], steps: int) -> Values:
    module = workshop.module(variant)
    assert is_simulation(module)
    short = module.solve(steps, duration=h * steps, start=start)
    long = module.solve(LONG, duration=h * LONG, start=start, every=LONG // 1000)
    return {
        "q": short.q[:, 0],
        "p": short.p[:, 0],
        "largest drift": np.abs(short.energy - short.energy[0]).max(),
        "final drift": short.energy[-1] - short.energy[0],
        "largest drift in the long run": np.abs(long.energy - long.energy[0]).max(),
        "slope in the long run": _slope(long.t, long.energy),
    }


def _slope(t: Any, energy: Any) -> float:
    half = t.size // 2
    return float(np.polyfit(t[half:], energy[half:], 1)[0])


def pendulum_sections(store: Store, problem: Path) -> list[Section]:
    """The portraits, and the drift numbers."""
    del problem
    rows = []
    for scheme, h, starts, steps in PORTRAITS:
        for start in starts:
            values = store.get(PENDULUM_SECTION, f"{scheme}; {start}")
            if values is not None:
                rows.append((
                    scheme, number(h), f"({start[0]:g}, {start[1]:g})", str(steps), number(values["largest drift"]),
                    number(values["final drift"]), number(values["largest drift in the long run"]),
                    number(values["slope in the long run"], 2),
                ))  # fmt: skip
    head = ("scheme", "h", "z₀", "steps", "largest |H − H₀|", "final H − H₀", f"largest after {LONG:,} steps",
            "slope of H per unit of time then")  # fmt: skip
    text = (
        "The thesis's Figure 1.3: explicit Euler spirals out, implicit Euler in, the symplectic methods stay near "
        "level curves of H (grey). The number of steps is not in the thesis; explicit Euler's portrait stops before "
        "the pendulum turns over."
    )
    table = Table("Drift of energy. A bounded drift without slope is what a symplectic method promises.", head,
                  tuple(rows))  # fmt: skip
    return [Section("Pendulum: phase portraits (Figure 1.3)", (text,), (table,),
                    (Picture("Phase portraits in the plane of q and p.", svg(lambda: portraits(store))),))]  # fmt: skip


def portraits(store: Store) -> Figure:
    """Four panels as in the thesis."""
    figure = Figure(figsize=(8.6, 6.4), layout="constrained")
    panels = figure.subplots(2, 2, sharex=True, sharey=True).ravel()
    q, p = np.meshgrid(np.linspace(-3.4, 3.4, 200), np.linspace(-2.4, 2.4, 160))
    for axes, (scheme, h, starts, _) in zip(panels, PORTRAITS, strict=True):
        levels = sorted({0.5 * p0**2 - np.cos(q0) for q0, p0 in starts})
        axes.contour(q, p, p**2 / 2 - np.cos(q), levels=levels, colors=[GREY], linewidths=0.9, linestyles="-")
        for start in starts:
            values = store.get(PENDULUM_SECTION, f"{scheme}; {start}") or {"q": [], "p": []}
            places = (np.array(values["q"]) + np.pi) % (2.0 * np.pi) - np.pi
            axes.plot(places, values["p"], ".", markersize=3.0, color=colour_of(scheme))
            axes.plot(*start, "o", markersize=4.5, markerfacecolor="white", color=colour_of(scheme))
        axes.set(title=f"{scheme}, $h = {h}$", aspect="equal", xlim=(-3.3, 3.3), ylim=(-2.4, 2.4))
    for axes in panels[2:]:
        axes.set_xlabel("$q$")
    for axes in panels[::2]:
        axes.set_ylabel("$p$")
    return figure
