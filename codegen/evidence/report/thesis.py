"""Experiments of the thesis on problems of the gallery: further modules, cases and sections.

Figures 3.3 to 3.9 of the thesis show the orbital transfer by the midpoint rule and by Euler's method. A Runge-Kutta
code, R-K, checks them. It interpolates the optimal force of the midpoint rule by a cubic spline and integrates the
equations of motion with this force. The motion should end on the target orbit. Its miss distance is an error that does
not depend on the generated code.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.projections.polar import PolarAxes
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline

from codegen.evidence.report import building, landmark_study
from codegen.evidence.report.building import SURVEYS, Variant, Workshop
from codegen.evidence.report.comparison import measured_order, order_text, verdict
from codegen.evidence.report.optima import solved
from codegen.evidence.report.page import Picture, Section, Table, colour_of, number, seconds, svg
from codegen.evidence.report.store import Case, Extent, Store, Values, quick_settings
from codegen.show.figures.picture import BLUE, CRIMSON, DARK, GREEN, GREY, RED, body_colours
from codegen.solving.loading import ControlModule, ControlSolution, Vector

# ---- Hovercraft ----

HOVERCRAFT_SECTION = "hovercraft: figures A.1 to A.5"
CRAFT = (3, 5)
HOVERCRAFT_ROWS = tuple(("variational", "midpoint", 2, (("craft", str(count)),)) for count in CRAFT)
HOVERCRAFT_STEPS = 20


def hovercraft_cases(problem: Path, variants: Sequence[Variant], workshop: Workshop, extent: Extent) -> Iterator[Case]:
    """Yield a case for each number of craft."""
    for variant, count in zip(variants, CRAFT, strict=True):
        yield Case(HOVERCRAFT_SECTION, f"{count} craft", partial(_formation, workshop, variant, extent.time_budget))


def _formation(workshop: Workshop, variant: Variant, budget: float) -> Values:
    """Return a solution with the positions and headings of the initial guess and of the optimum."""
    module = workshop.control(variant)
    grid, shape = module.make_grid(HOVERCRAFT_STEPS), (HOVERCRAFT_STEPS + 1, module.metadata.bodies, 3)
    _, guess, *_ = module.unpack(grid, module.initial_guess(grid))
    optimum = module.solve(HOVERCRAFT_STEPS).q
    values = solved(module, HOVERCRAFT_STEPS, budget=budget)
    return {**values, "guess": guess.reshape(shape), "optimum": optimum.reshape(shape)}


def hovercraft_sections(store: Store, problem: Path) -> list[Section]:
    """Return the section with a table of solves and the figure of the paths."""
    runs = {n: values for n in CRAFT if (values := store.get(HOVERCRAFT_SECTION, f"{n} craft")) is not None}
    if not runs:
        return []
    rows = tuple(
        (str(count), v["status"], f"{v['cost']:.9g}", seconds(v["seconds"]), str(v["iterations"]),
         number(v["residual"], 2), number(v["stationarity"], 2))
        for count, v in runs.items()
    )  # fmt: skip
    head = ("craft", "status", "cost", "time", "iterations", "residual", "stationarity")
    table = Table(f"Hovercraft on N = {HOVERCRAFT_STEPS} intervals.", head, rows)
    picture = Picture(
        "First guess (left) and optimum (right); arrows show the heading at every other node.", svg(_paths, runs)
    )
    return [Section("Hovercraft: Figures A.1 to A.5", (), (table,), (picture,))]


def _paths(runs: dict[int, Values]) -> Figure:
    """Draw a row for each number of craft: paths with headings, and the polygon of the final positions."""
    figure = Figure(figsize=(8.6, 4.3 * len(runs)), layout="constrained")
    rows = figure.subplots(len(runs), 2, squeeze=False, sharex="row", sharey="row")
    for row, (count, values) in zip(rows, runs.items(), strict=True):
        for axes, name in zip(row, ("guess", "optimum"), strict=True):
            states = np.array(values[name], dtype=float)  # shape (N + 1, craft, 3)
            ends = states[-1, :, :2]
            axes.plot(*np.vstack([ends, ends[:1]]).T, color=GREY, linewidth=0.8)
            for body, colour in enumerate(body_colours(states.shape[1], "")):
                x, y, heading = states[:, body].T
                axes.plot(x, y, color=colour)
                axes.plot(x[0], y[0], "x", color=colour, markersize=5)
                axes.plot(x[-1], y[-1], "o", color=colour, markersize=4)
                axes.quiver(x[::2], y[::2], np.cos(heading[::2]), np.sin(heading[::2]), color=CRIMSON, angles="xy",
                            scale=14, width=0.004, headwidth=4)  # fmt: skip
            axes.set(aspect="equal", xlabel="$x$", title=f"{count} craft, {name}")
        row[0].set_ylabel("$y$")
    return figure


# ---- Landmarks ----


def landmark_cases(problem: Path, variants: Sequence[Variant], workshop: Workshop, extent: Extent) -> Iterator[Case]:
    """Yield the cases of the quick study for every extent: the complete study takes longer than all other cases."""
    for _, part in landmark_study.PARTS:
        yield from part(quick_settings(problem), workshop.store)


def landmark_sections(store: Store, problem: Path) -> list[Section]:
    """Return the thesis's tables and figures for one small set of landmarks and for the trilobites."""
    reason = f"One set of few landmarks, fast routes, no open questions: codegen report {problem.name} has them all."
    return [Section(f"{problem.stem}: landmarks", (reason,)), *landmark_study.sections(quick_settings(problem), store)]


# ---- Linearised pendulum ----

LINEAR_SECTION = "linear_pendulum: figures 3.1 and 3.2"
LINEAR_STEPS = tuple(range(10, 201, 5))
LINEAR_METHODS = (
    ("Var.", "variational", "midpoint", 2, BLUE, "-"),
    ("Euler", "hamiltonian", "explicit-euler", 1, RED, "-"),
    ("Ham. Eq'ns", "hamiltonian", "midpoint", 2, GREEN, "--"),
)
"""Name in the thesis, method, scheme, order, colour and style of the line."""
LINEAR_ROWS = tuple(row[1:4] for row in LINEAR_METHODS)


def linear_pendulum_cases(
    problem: Path, variants: Sequence[Variant], workshop: Workshop, extent: Extent
) -> Iterator[Case]:
    """Yield a case for each transcription and N = 10, 15, ..., 200, or every fourth N in a quick report."""

    def measure(variant: Variant, steps: int) -> Values:
        return solved(workshop.control(variant), steps, budget=extent.time_budget)

    for variant, (label, *_) in zip(variants, LINEAR_METHODS, strict=True):
        for steps in LINEAR_STEPS[::4] if extent.quick else LINEAR_STEPS:
            yield Case(LINEAR_SECTION, f"{label}; N {steps}", partial(measure, variant, steps))


def _rows(store: Store, label: str) -> list[Values]:
    return [values for name, values in store.rows(LINEAR_SECTION) if name.startswith(f"{label}; ")]


def linear_pendulum_sections(store: Store, problem: Path) -> list[Section]:
    """Return the section with cost, error and time against the number of steps."""
    exact = (store.get(SURVEYS, problem.stem) or {}).get("exact cost")
    if exact is None or not _rows(store, "Var."):
        return []
    rows = []
    for label, method, scheme, order, *_ in LINEAR_METHODS:
        values = _rows(store, label)
        errors = [abs(v["cost"] - exact) for v in values]
        measured = measured_order([v["steps"] for v in values], errors)
        rows.append((
            label, f"{method} {scheme}", str(order), order_text(measured, verdict(measured, order)),
            number(errors[0], 2), number(errors[-1], 2), seconds(values[0]["seconds"]),
            seconds(values[-1]["seconds"]), str(sum(v["status"] != "solved" for v in values)),
        ))  # fmt: skip
    first, last = _rows(store, "Var.")[0]["steps"], _rows(store, "Var.")[-1]["steps"]
    head = ("thesis", "here", "stated order", "measured", f"error at N = {first}", f"at N = {last}",
            f"time at N = {first}", f"at N = {last}", "failed")  # fmt: skip
    text = (
        f"The exact cost, {exact:.15g}, is the closed form that is derived from the problem file. Controls belong to "
        "intervals here, and to nodes in the thesis. By the midpoint rule both give the same cost, to 14 digits."
    )
    table = Table("The transcriptions of section 3.2.", head, tuple(rows))
    caption = "Cost, its error, and time of one solve against the number of steps N = 10:5:200."
    picture = Picture(caption, svg(_linear_figure, store, exact))
    return [Section("Linearised pendulum: Figures 3.1 and 3.2", (text,), (table,), (picture,))]


def _linear_figure(store: Store, exact: float) -> Figure:
    """Draw cost, error and time against the number of steps."""
    figure = Figure(figsize=(9.6, 3.3), layout="constrained")
    costs, errors, times = figure.subplots(1, 3)
    for label, _, _, _, colour, style in LINEAR_METHODS:
        rows = _rows(store, label)
        steps = [v["steps"] for v in rows]
        look = {"color": colour, "linestyle": style}
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
    return figure


# ---- Orbital transfer ----

ORBIT_SECTION = "orbital_transfer: figures 3.3 to 3.9"
ORBIT_METHODS = (("Mid.", "variational", "midpoint", 2, BLUE), ("Euler", "hamiltonian", "explicit-euler", 1, RED))
ORBIT_ROWS = (*(row[1:4] for row in ORBIT_METHODS), ("variational", "midpoint", 2, (), False, "nodal"))
NODAL = "Mid., controls at nodes"
SWEEPS = {1: tuple(range(10, 51, 5)), 2: tuple(range(10, 101, 10))}
FORCES = {1: (50, 100, 150), 2: (100, 200, 300)}
"""Numbers of steps by number of revolutions: SWEEPS for Figures 3.3 and 3.4, FORCES for Figures 3.7 to 3.9."""
TOLERANCE = 1e-11


def orbit_cases(problem: Path, variants: Sequence[Variant], workshop: Workshop, extent: Extent) -> Iterator[Case]:
    """Yield cases: both methods, one and two revolutions; motions with the numbers of steps in FORCES are stored.

    Controls at nodes have cases for FORCES only.
    """
    *by_method, nodal = variants
    for revolutions, counts in FORCES.items():
        for steps in counts:
            measure = partial(_transfer, workshop, nodal, revolutions, steps, extent.time_budget)
            yield Case(ORBIT_SECTION, _name(NODAL, revolutions, steps), measure)
    for variant, (label, *_) in zip(by_method, ORBIT_METHODS, strict=True):
        for revolutions, sweep in SWEEPS.items():
            wanted = sorted({*(sweep[::3] if extent.quick else sweep), *FORCES[revolutions]})
            for steps in wanted:
                measure = partial(_transfer, workshop, variant, revolutions, steps, extent.time_budget)
                yield Case(ORBIT_SECTION, _name(label, revolutions, steps), measure)


def _name(label: str, revolutions: int, steps: int) -> str:
    return f"{label}; {revolutions} revolutions; N {steps}"


def _transfer(workshop: Workshop, variant: Variant, revolutions: int, steps: int, budget: float) -> Values:
    """Return a solution and its time; for the midpoint rule also the motion by R-K."""
    module = workshop.control(variant)
    solve = partial(module.solve, steps, revolutions=float(revolutions))
    solution, measured = solve(), building.timed(solve, budget)
    values: dict[str, object] = {
        "status": solution.status, "cost": solution.cost, "seconds": measured.processor, "steps": steps,
        "iterations": solution.iterations, "residual": solution.residual,
    }  # fmt: skip
    if variant.scheme == "midpoint" and variant.controls == "interval":
        values |= _reintegrated(module, solution, revolutions)
    if steps in FORCES[revolutions]:
        values |= {"r": solution.q[:, 0], "phi": solution.q[:, 1], "t": solution.t, "u": solution.u[:, 0]}
    return values


def _reintegrated(module: ControlModule, solution: ControlSolution, revolutions: int) -> Values:
    """Integrate m (r'' - r phi'^2) = -GM m/r^2 and (m r^2 phi')' = r u, u splined; return the motion and its misses."""
    values = module.metadata.parameters
    m, gravity, r0, r1 = (values[name] for name in ("m", "GM", "r0", "r1"))
    t = solution.t
    force = CubicSpline(0.5 * (t[1:] + t[:-1]), solution.u[:, 0])

    def field(instant: float, z: Vector) -> list[float]:
        r, _, y, w = z
        return [y, w, r * w * w - gravity / r**2, (float(force(instant)) / m - 2.0 * y * w) / r]

    start = [r0, 0.0, 0.0, math.sqrt(gravity / r0**3)]
    done = solve_ivp(field, (t[0], t[-1]), start, "DOP853", rtol=TOLERANCE, atol=TOLERANCE,
                     t_eval=np.linspace(t[0], t[-1], 201))  # fmt: skip
    r, phi, y, w = done.y[:, -1]
    angle = 2.0 * math.pi * revolutions
    miss = math.hypot(r * math.cos(phi) - r1 * math.cos(angle), r * math.sin(phi) - r1 * math.sin(angle))
    velocity = math.hypot(y, r * w - r1 * math.sqrt(gravity / r1**3))
    return {"miss": miss, "velocity miss": velocity, "R-K r": done.y[0], "R-K phi": done.y[1]}


def _sweep(store: Store, label: str, revolutions: int) -> list[Values]:
    names = (_name(label, revolutions, n) for n in SWEEPS[revolutions])
    return [values for name in names if (values := store.get(ORBIT_SECTION, name)) is not None]


def orbit_sections(store: Store, problem: Path) -> list[Section]:
    """Return the section with costs, times, orbits, forces and the miss distance of R-K."""
    if not _sweep(store, "Mid.", 1):
        return []
    text = (
        "R-K interpolates the optimal force of Mid. by a cubic spline (controls of an interval stand at its middle) "
        "and integrates the forced equations of section 3.3, written out here by hand, by DOP853 at tolerance "
        f"{TOLERANCE:g}: where it ends should be the target, the more so the larger N. The noise in the thesis's "
        "forces has a cause that more steps do not remove. Controls at nodes enter the cost by the mean of two "
        "neighbours, so that an alternating force u, -u, u, ... costs nothing. Yet it acts on the motion, and the "
        "discrete cost falls below the true one. The optimum does not determine the size of such a force."
    )
    pictures = (
        Picture("Costs, times and miss of R-K (Figures 3.3 and 3.4; the miss is not in the thesis).",
                svg(_costs, store)),
        Picture("Orbits of the three methods (Figures 3.5 and 3.6); grey: first and last orbit.", svg(_orbits, store)),
        Picture("Optimal forces (Figures 3.7 to 3.9) with controls on intervals.", svg(_forces, store)),
        Picture("The same with controls at nodes, as in the thesis: the noise of Figures 3.7 to 3.9. The largest "
                "forces above are below 1.", svg(_forces, store, True)),
    )  # fmt: skip
    rows = []
    for revolutions in SWEEPS:
        for label, *_ in ORBIT_METHODS:
            values = _sweep(store, label, revolutions)
            last = values[-1]
            order = measured_order([v["steps"] for v in values], [v.get("miss") for v in values])
            rows.append((
                label, str(revolutions), str(last["steps"]), f"{last['cost']:.8g}", seconds(last["seconds"]),
                str(last["iterations"]), number(last.get("miss")), number(last.get("velocity miss")),
                order_text(order, verdict(order, 2)), str(sum(v["status"] != "solved" for v in values)),
            ))  # fmt: skip
    head = ("method", "revolutions", "N", "cost", "time", "iterations", "miss of R-K", "its velocity miss",
            "order of the miss", "failed")  # fmt: skip
    sweeps = Table("The largest N of each sweep.", head, tuple(rows))
    forces = []
    for revolutions, counts in FORCES.items():
        for steps in counts:
            runs = [store.get(ORBIT_SECTION, _name(label, revolutions, steps)) for label in (NODAL, "Mid.")]
            cells = [(f"{v['cost']:.7g}", number(float(np.abs(v["u"]).max()))) for v in runs if v is not None]
            forces.append((str(revolutions), str(steps), *(cell for pair in cells for cell in pair)))
    of_forces = ("revolutions", "N", "cost, controls at nodes", "largest |u|", "controls on intervals", "largest |u|")
    tables = sweeps, Table("Forces with controls at nodes and on intervals.", of_forces, tuple(forces))
    return [Section("Orbital transfer: Figures 3.3 to 3.9", (text,), tables, pictures)]


def _costs(store: Store) -> Figure:
    """Draw a row for each number of revolutions: cost, time and miss distance of R-K against N."""
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
    for panel in axes[1]:
        panel.set_xlabel("steps $N$")
    axes[0][0].legend()
    axes[0][2].legend()
    return figure


def _orbits(store: Store) -> Figure:
    """Draw the orbits in polar coordinates, with the smallest N of the figures of forces."""
    figure = Figure(figsize=(8.6, 4.2), layout="constrained")
    for column, (revolutions, steps) in enumerate((p, FORCES[p][0]) for p in SWEEPS):
        axes = figure.add_subplot(1, 2, column + 1, projection="polar")
        assert isinstance(axes, PolarAxes)
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
        if column == 1:
            axes.legend(loc="center")
    return figure


def _forces(store: Store, nodal: bool = False) -> Figure:
    """Draw the forces by midpoint and Euler against time, or by midpoint with controls at nodes."""
    figure = Figure(figsize=(9.6, 4.6 if nodal else 5.4), layout="constrained")
    axes = figure.subplots(2, 3, sharex="row", sharey="none" if nodal else "row")
    for row, (revolutions, counts) in zip(axes, FORCES.items(), strict=True):
        for panel, steps in zip(row, counts, strict=True):
            for label, colour in [(NODAL, BLUE)] if nodal else [(label, colour) for label, *_, colour in ORBIT_METHODS]:
                values = store.get(ORBIT_SECTION, _name(label, revolutions, steps))
                if values is not None and nodal:
                    panel.plot(values["t"], values["u"], color=colour, linewidth=0.7)
                elif values is not None:
                    panel.stairs(values["u"], values["t"], color=colour, label=label, baseline=None, linewidth=1.2)
            panel.set(title=f"$p = {revolutions}$, $N = {steps}$", xlabel="time")
        row[0].set_ylabel("force $u$ at nodes" if nodal else "force $u$")
    if not nodal:
        axes[0][0].legend()
    return figure


# ---- Pendulum ----

PENDULUM_SECTION = "pendulum: figure 1.3"
PORTRAITS = (
    ("explicit-euler", 0.2, ((0.5, 0.0),), 124),
    ("implicit-euler", 0.2, ((1.5, 0.0),), 124),
    ("symplectic-euler", 0.3, ((0.0, 0.7), (0.0, 1.4), (0.0, 2.1)), 29),
    ("midpoint", 0.3, ((0.0, 0.7), (0.0, 1.4), (0.0, 2.1)), 29),
)
"""Scheme, time step, initial states (q, p) and number of steps, as in appendix C of the thesis: 125 and 30 points."""
PENDULUM_ROWS = tuple(("hamiltonian", scheme, 2 if scheme == "midpoint" else 1) for scheme, *_ in PORTRAITS)
LONG = 100_000  # the number of steps after which the drift of energy is measured again


def pendulum_cases(problem: Path, variants: Sequence[Variant], workshop: Workshop, extent: Extent) -> Iterator[Case]:
    """Yield a case for every method and initial state."""
    for variant, (scheme, h, starts, steps) in zip(variants, PORTRAITS, strict=True):
        for start in starts:
            yield Case(PENDULUM_SECTION, f"{scheme}; {start}", partial(_portrait, workshop, variant, h, start, steps))


def _portrait(workshop: Workshop, variant: Variant, h: float, start: tuple[float, float], steps: int) -> Values:
    """Return the path in phase space, and the drift of energy on this path and on a long path."""
    module = workshop.simulation(variant)
    short = module.solve(steps, duration=h * steps, start=start)
    long = module.solve(LONG, duration=h * LONG, start=start, every=LONG // 1000)
    assert short.energy is not None, "a pendulum has an energy"
    assert long.energy is not None, "a pendulum has an energy"
    half = long.t.size // 2
    return {
        "q": short.q[:, 0],
        "p": short.p[:, 0],
        "largest drift": np.abs(short.energy - short.energy[0]).max(),
        "final drift": short.energy[-1] - short.energy[0],
        "largest drift in the long run": np.abs(long.energy - long.energy[0]).max(),
        "slope in the long run": float(np.polyfit(long.t[half:], long.energy[half:], 1)[0]),
    }


def pendulum_sections(store: Store, problem: Path) -> list[Section]:
    """Return the section with the phase portraits and the drifts of energy."""
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
        "level curves of H (grey). Time steps, initial states and numbers of steps are those of the thesis, appendix C."
    )
    table = Table("Drift of energy. A bounded drift without slope is what a symplectic method promises.", head,
                  tuple(rows))  # fmt: skip
    picture = Picture("Phase portraits in the plane of q and p.", svg(_portraits, store))
    return [Section("Pendulum: phase portraits (Figure 1.3)", (text,), (table,), (picture,))]


def _portraits(store: Store) -> Figure:
    """Draw the phase portraits in four panels, as in the thesis."""
    figure = Figure(figsize=(8.6, 6.4), layout="constrained")
    panels = figure.subplots(2, 2, sharex=True, sharey=True).ravel()
    q, p = np.meshgrid(np.linspace(-3.4, 3.4, 200), np.linspace(-2.4, 2.4, 160))
    for axes, (scheme, h, starts, _) in zip(panels, PORTRAITS, strict=True):
        levels = sorted({0.5 * p0**2 - np.cos(q0) for q0, p0 in starts})
        axes.contour(q, p, p**2 / 2 - np.cos(q), levels=levels, colors=[GREY], linewidths=0.9, linestyles="-")
        for start in starts:
            values = store.get(PENDULUM_SECTION, f"{scheme}; {start}") or {"q": [], "p": []}
            angles = (np.array(values["q"]) + np.pi) % (2.0 * np.pi) - np.pi
            axes.plot(angles, values["p"], ".", markersize=3.0, color=colour_of(scheme))
            axes.plot(*start, "o", markersize=4.5, markerfacecolor="white", color=colour_of(scheme))
        axes.set(title=f"{scheme}, $h = {h}$", aspect="equal", xlim=(-3.3, 3.3), ylim=(-2.4, 2.4))
    for axes in panels[2:]:
        axes.set_xlabel("$q$")
    for axes in panels[::2]:
        axes.set_ylabel("$p$")
    return figure
