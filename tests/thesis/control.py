"""Chapters 1 to 3 and appendix A of the thesis: integrators, optimal control, hovercraft.

Values of the thesis are in `Row.there`; most figures have axes without numbers, so that only their statement remains.
Limits of `Row` say what counts as reproduced. Times have no limits, or wide ones, because machines differ.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import sympy
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline
from sympy import Matrix, cos, sin

from thesis.entries import (
    ROOT,
    Agreement,
    Entry,
    Kind,
    Row,
    Runs,
    Vector,
    collected,
    order,
)
from thesis.errata import modified_field, p, q, size

MOTIONS: list[Entry] = []
figure, table = collected(Kind.FIGURE, MOTIONS), collected(Kind.TABLE, MOTIONS)
claim, question = collected(Kind.CLAIM, MOTIONS), collected(Kind.QUESTION, MOTIONS)

PENDULUM = "codegen solve problems/pendulum.py"
LINEAR = "codegen solve problems/linear_pendulum.py"
TRANSFER = "codegen solve problems/orbital_transfer.py"
EULERS = "--scheme explicit-euler --method hamiltonian"
SCHEMES = ("explicit-euler", "implicit-euler", "symplectic-euler", "midpoint")

# ---- Chapter 1 ----


@figure(
    "figure-1.1", "Figure 1.1", "An image is warped along the paths of control points that were picked by mouse.",
    "codegen warp tests/thesis/image.png --landmarks tests/thesis/image.csv --align none --out {folder}/warped.png",
    remark="The Mona Lisa is not in the repository, so a test image takes its place. `codegen app` picks points in "
    "the browser.",
    agreement=Agreement.OTHER_DATA,
)  # fmt: skip
def _(run: Runs) -> Iterator[Row]:
    done = run(0, folder=run.folder)
    yield Row("exit status", done.status, "a picture", 0, 0)
    yield Row("largest miss of a landmark, pixels", max(done.record["summary"]["residuals"]), "", high=1e-6)
    yield Row("least Jacobian determinant of the map", done.record["summary"]["det_min"], low=1e-3)


@figure(
    "figure-1.2", "Figure 1.2", "A simple pendulum with the energy $H = p^2/2 - \\cos q$.",
    PENDULUM + " --scheme gauss-6 --steps {N} --plot {folder}/pendulum.png",
    remark="The figure is a sketch. `--plot` draws the pendulum and its motion.",
)  # fmt: skip
def _(run: Runs) -> Iterator[Row]:
    done = run(0, N=600, folder=run.folder)
    energy = done.arrays["p"][:, 0] ** 2 / 2 - np.cos(done.arrays["q"][:, 0])
    yield Row("largest change of H along the motion, from (0, 1.4)", np.ptp(energy), "H is constant", high=1e-9)


@figure(
    "figure-1.3", "Figure 1.3 and appendix C",
    "Explicit Euler spirals out, implicit Euler spirals in. Symplectic Euler and midpoint stay near level curves of H, "
    "midpoint nearer.",
    *(f"{PENDULUM} --scheme {own} --steps {{N}} --parameter duration={{T}} --parameter start.q={{q}} "
      "--parameter start.p={p}" for own in SCHEMES),
    remark="The number of steps is in appendix C: 125 points for h = 0.2, 30 points for h = 0.3.",
)  # fmt: skip
def _(run: Runs) -> Iterator[Row]:
    drifts, points = [], []
    for number in range(4):
        starts = ((0.5, 0.0), (1.5, 0.0))[number : number + 1] or ((0.0, 0.7), (0.0, 1.4), (0.0, 2.1))
        steps, step = (124, 0.2) if number < 2 else (29, 0.3)
        runs = [run(number, N=steps, T=steps * step, q=q0, p=p0).arrays for q0, p0 in starts]
        energies = [each["p"][:, 0] ** 2 / 2 - np.cos(each["q"][:, 0]) for each in runs]
        drifts.append([energy - energy[0] for energy in energies])
        points.append(runs[0]["t"].size)
    yield Row("points, Euler methods", points[0], "125", 125, 125)
    yield Row("points, symplectic methods", points[2], "30", 30, 30)
    yield Row("explicit Euler, change of H at the end", drifts[0][0][-1], "spirals out", low=0.1)
    yield Row("implicit Euler, change of H at the end", drifts[1][0][-1], "spirals in", high=-0.1)
    worst = [max(np.abs(drift).max() for drift in drifts[number]) for number in (2, 3)]
    yield Row("symplectic Euler, largest change of H", worst[0], "near level curves", high=0.5)
    yield Row("midpoint, largest change of H", worst[1], "nearer", high=worst[0] / 2)


@claim(
    "area", "Chapter 1, page 17",
    "The flows of the methods have the determinants $1 + h^2\\cos q_0$, $(1 + h^2\\cos q_1)^{-1}$, 1 and 1.",
    *(f"{PENDULUM} --scheme {own} --steps 1 --parameter duration=0.2 --parameter start.q={{q}} --parameter "
    f"start.p={{p}}"
      for own in SCHEMES),
    remark="Central differences of one step, h = 0.2, from (0.6, 0.7). `codegen check problems/pendulum.py` proves the "
    "formulas.",
)  # fmt: skip
def _(run: Runs) -> Iterator[Row]:
    for number, scheme in enumerate(SCHEMES):
        ends = {}
        for name, shift in {"": (0, 0), "q": (1e-4, 0), "-q": (-1e-4, 0), "p": (0, 1e-4), "-p": (0, -1e-4)}.items():
            done = run(number, q=0.6 + shift[0], p=0.7 + shift[1]).arrays
            ends[name] = np.array([done["q"][-1, 0], done["p"][-1, 0]])
        columns = [(ends[name] - ends[f"-{name}"]) / 2e-4 for name in "qp"]
        expected = (1 + 0.04 * math.cos(0.6), 1 / (1 + 0.04 * math.cos(ends[""][0])), 1.0, 1.0)[number]
        here = np.linalg.det(np.array(columns).T)
        yield Row(f"determinant, {scheme}", here, f"{expected:.8f}", expected - 1e-8, expected + 1e-8)


@claim(
    "order-of-midpoint", "Chapter 1, page 18", "The midpoint rule has a greater order than the other three methods.",
    *(f"{PENDULUM} --scheme {own} --steps {{N}} --parameter duration=3" for own in SCHEMES),
)  # fmt: skip
def _(run: Runs) -> Iterator[Row]:
    field = lambda _, z: [z[1], -math.sin(z[0])]  # noqa: E731
    exact = solve_ivp(field, (0, 3), [0.0, 1.4], "DOP853", rtol=1e-13, atol=1e-13).y[:, -1]
    for number, scheme in enumerate(SCHEMES):
        counts = (200, 400, 800)
        ends = [run(number, N=n).arrays for n in counts]
        errors = [np.hypot(e["q"][-1, 0] - exact[0], e["p"][-1, 0] - exact[1]) for e in ends]
        expected = 2 if scheme == "midpoint" else 1
        yield Row(f"order, {scheme}", order(counts, errors), str(expected), expected - 0.1, expected + 0.1)


# ---- Chapter 2 ----


@claim(
    "discrete-lagrangians", "Sections 2.1 and 2.2",
    "Discrete Euler-Lagrange equations follow from the rectangle rule and from the midpoint rule.",
    PENDULUM + " --set form=lagrangian --scheme rectangle --steps 50 --parameter duration=10",
    PENDULUM + " --set form=lagrangian --scheme midpoint --steps 50 --parameter duration=10",
    remark="Residuals of $D_2L_d + D_1L_d = 0$, written by hand for the pendulum.",
)  # fmt: skip
def _(run: Runs) -> Iterator[Row]:
    for number, name in enumerate(("rectangle rule", "midpoint rule")):
        place, step = run(number).arrays["q"][:, 0], 0.2
        inertia = np.diff(place, 2) / step**2
        middle = np.sin((place[1:] + place[:-1]) / 2)
        pull = np.sin(place[1:-1]) if number == 0 else (middle[1:] + middle[:-1]) / 2
        yield Row(f"largest residual, {name}", np.abs(inertia + pull).max(), "0", high=1e-10)


@claim(
    "symplectic-midpoint", "Example 2.4.2",
    "$(I - hJ\\nabla^2H/2)\\,\\partial\\Phi = I + hJ\\nabla^2H/2$, and the map is symplectic.",
    remark="A random symmetric matrix of second derivatives, three degrees of freedom.",
)  # fmt: skip
def _(run: Runs) -> Iterator[Row]:
    second = np.random.default_rng(1).normal(size=(6, 6))
    J = np.kron([[0, 1], [-1, 0]], np.eye(3))
    half = 0.05 * J @ (second + second.T)
    map_ = np.linalg.solve(np.eye(6) - half, np.eye(6) + half)
    yield Row("largest entry of $\\Phi^TJ\\Phi - J$", np.abs(map_.T @ J @ map_ - J).max(), "0", high=1e-12)


@claim(
    "midpoint-is-variational", "Example 2.4.3",
    "The midpoint rule is the discrete Hamiltonian map of $L_d = hL(q_{k+1/2}, v_{k+1/2})$.",
    PENDULUM + " --set form=lagrangian --method variational --scheme midpoint --steps 100",
    PENDULUM + " --scheme midpoint --steps 100",
)  # fmt: skip
def _(run: Runs) -> Iterator[Row]:
    first, second = run(0).arrays, run(1).arrays
    yield Row("largest difference of q", np.abs(first["q"] - second["q"]).max(), "0", high=1e-9)
    yield Row("largest difference of p", np.abs(first["p"] - second["p"]).max(), "0", high=1e-9)


@claim(
    "modified-equations", "Equations (2.5.5) and (2.5.7)",
    "Modified equations of symplectic and explicit Euler up to $h^2$. The divergence of (2.5.7) is "
    "$h\\cos q + h^2p\\sin q/2$.",
    "codegen analyse problems/pendulum.py --scheme symplectic-euler --order 2",
    "codegen analyse problems/pendulum.py --scheme explicit-euler --order 2",
    remark="Differences of the printed terms from a Taylor expansion that is independent of the package, and from the "
    "package.",
)  # fmt: skip
def _(run: Runs) -> Iterator[Row]:
    from codegen.discretise import schemes
    from codegen.discretise.model.from_problem import load_problem
    from codegen.evidence.analysis.modified_equations import modified_equations

    printed = {
        "symplectic-euler": [(-sin(q) / 2, p * cos(q) / 2), (p * cos(q) / 6, (p**2 - 2 * cos(q)) * sin(q) / 12)],
        "explicit-euler": [(sin(q) / 2, p * cos(q) / 2), (-p * cos(q) / 3, (p**2 + 4 * cos(q)) * sin(q) / 12)],
    }
    arguments = {"symplectic-euler": lambda one_q, one_p: (one_p, q), "explicit-euler": lambda one_q, one_p: (p, q)}
    model: Any = load_problem(ROOT / "problems" / "pendulum.py")
    for number, (scheme, terms) in enumerate(printed.items()):
        assert run(number).status == 0
        fields = modified_field(arguments[scheme])[1:]
        pairs = list(zip(sum(fields, ()), sum(terms, ()), strict=True))
        yield Row(f"{scheme}, expansion", size([a - b for a, b in pairs]), "0", high=1e-12)
        found = modified_equations(model, schemes.find(scheme, "hamiltonian"), 2)
        names = dict(zip(found.states, (q, p), strict=True))
        own = [each.xreplace(names) for field in found.field[1:] for each in field]
        yield Row(f"{scheme}, package", size([a - b for a, b in zip(own, sum(terms, ()))]), "0", high=1e-12)
    first, second = (Matrix(field).jacobian([q, p]).trace() for field in printed["explicit-euler"])
    yield Row("divergence of (2.5.7)", size([first - cos(q), second - p * sin(q) / 2]), "0", high=1e-12)


# ---- Chapter 3: the linearised pendulum ----


@claim(
    "forced-equations", "Sections 2.3 and 3.1, equations (3.1.3)",
    "The optimum satisfies the forced discrete Euler-Lagrange equations and the momentum boundary conditions.",
    LINEAR + " --steps 50",
    remark="Residuals of the equations, written by hand for the linearised pendulum at rest at both ends.",
)  # fmt: skip
def _(run: Runs) -> Iterator[Row]:
    done = run(0).arrays
    place, push, step = done["q"][:, 0], done["u"][:, 0], math.pi / 100
    speed, middle = np.diff(place) / step, (place[1:] + place[:-1]) / 2
    first = -speed - step / 2 * middle + step / 2 * push  # D1 Ld + f-
    last = speed - step / 2 * middle + step / 2 * push  # D2 Ld + f+
    yield Row("inner nodes", np.abs(last[:-1] + first[1:]).max(), "0", high=1e-12)
    yield Row("momenta at both ends", max(abs(first[0]), abs(last[-1])), "0", high=1e-12)


def exact_pendulum() -> float:
    """Return the cost (3.2.5), with the constants that satisfy the boundary conditions."""
    t, (c1, c2, k1, k2) = sympy.Symbol("t"), sympy.symbols("c1 c2 k1 k2")
    place = k1 * cos(t) + k2 * sin(t) + c1 / 4 * t * cos(t) + c2 / 4 * t * sin(t)
    ends = ((0, 3), (sympy.pi / 2, 2))
    conditions = [place.subs(t, at) - value * sympy.pi / 5 for at, value in ends]
    conditions += [place.diff(t).subs(t, at) for at, _ in ends]
    found = sympy.solve(conditions, [c1, c2, k1, k2])
    return float((sympy.pi / 16 * (c1**2 + c2**2) - c1 * c2 / 4).subs(found))


@claim(
    "exact-pendulum", "Equations (3.2.4) and (3.2.5)", "$J^* = \\pi(c_1^2 + c_2^2)/16 - c_1c_2/4$.",
    remark="The other value is the closed form that the package derives from the maximum principle.",
)  # fmt: skip
def _(run: Runs) -> Iterator[Row]:
    from codegen.discretise.model.from_problem import load_problem
    from codegen.evidence.analysis.maximum_principle import exact_optimum

    model: Any = load_problem(ROOT / "problems" / "linear_pendulum.py")
    optimum = exact_optimum(model)
    assert optimum is not None, "the problem is linear"
    cost = optimum.cost_at()
    yield Row("$J^*$ of (3.2.5)", exact_pendulum(), "(3.2.5)", cost - 1e-12, cost + 1e-12)


@figure(
    "figure-3.1", "Figure 3.1",
    "The cost of the variational midpoint rule almost equals the exact cost, even for large steps. The cost of "
    "explicit Euler tends to it slowly.",
    LINEAR + " --steps {N} --repeat 5", f"{LINEAR} {EULERS} --steps {{N}} --repeat 5",
    remark="N = 10, 15, ..., 200.",
)  # fmt: skip
def _(run: Runs) -> Iterator[Row]:
    counts, exact = range(10, 201, 5), exact_pendulum()
    midpoint, euler = ([run(number, N=n).cost for n in counts] for number in (0, 1))
    yield Row("midpoint, largest relative error", max(abs(c / exact - 1) for c in midpoint), "almost equal", high=0.01)
    yield Row("midpoint, cost at N = 10", midpoint[0], "", exact, 1.01 * exact)
    yield Row("explicit Euler, cost at N = 10", euler[0], "well above the exact cost", low=1.05 * exact)
    yield Row("explicit Euler, cost at N = 200", euler[-1], "near the exact cost", exact, 1.05 * exact)
    for n in (10, 200):
        ratio = run(1, N=n).seconds / run(0, N=n).seconds
        yield Row(f"ratio of times at N = {n}, Euler to midpoint", ratio, "below 1" if n == 10 else "grows with N")
    for name, costs, expected in (("midpoint", midpoint, 2), ("explicit Euler", euler, 1)):
        here = order(counts[19:], [abs(c - exact) for c in costs[19:]])
        yield Row(f"{name}, order of the cost", here, f"{expected}, by (2.5.6)", expected - 0.2, expected + 0.2)


@figure(
    "figure-3.2", "Figure 3.2",
    "Variational constraints and midpoint differences of Hamilton's equations have close costs. The variational system "
    "has half the size and is solved more quickly.",
    LINEAR + " --steps {N} --repeat 20", LINEAR + " --method hamiltonian --steps {N} --repeat 20",
)  # fmt: skip
def _(run: Runs) -> Iterator[Row]:
    counts = (10, 50, 100, 150, 200)
    first, second = ([run(number, N=n) for n in counts] for number in (0, 1))
    difference = max(abs(a.cost / b.cost - 1) for a, b in zip(first, second, strict=True))
    yield Row("largest relative difference of costs", difference, "close", high=1e-3)
    yield Row("cost at N = 10", first[0].cost, "4.54 to 4.55, from the axis", 4.54, 4.55)
    sizes = [done[-1].arrays["unknowns"].size for done in (second, first)]
    yield Row("ratio of unknowns, Hamiltonian to variational", sizes[0] / sizes[1], "half the size", 1.2, 2.2)
    yield Row("ratio of times at N = 200", second[-1].seconds / first[-1].seconds, "above 1")


@claim(
    "nodal-pendulum", "Section 3.2, forces at nodes",
    "Controls on nodes do not change the costs of the linearised pendulum, so they explain no difference of the "
    "curves.",
    LINEAR + " --steps {N}", LINEAR + " --controls nodal --steps {N}",
    remark="Nodal controls alternate freely. Their averages, the motion and the cost do not change, because the "
    "problem is linear and its force does not depend on the state.",
)  # fmt: skip
def _(run: Runs) -> Iterator[Row]:
    for n in (10, 50, 200):
        difference = abs(run(1, N=n).cost / run(0, N=n).cost - 1)
        yield Row(f"relative difference of costs, N = {n}", difference, "", high=2e-14)


# ---- Chapter 3: the orbital transfer ----


def _transfer_costs(run: Runs, revolutions: int, counts: range) -> Iterator[Row]:
    exact = run(0, N=10 * counts[-1]).cost
    midpoint, euler = ([run(number, N=n) for n in counts] for number in (0, 1))
    for name, done, limit in (("midpoint", midpoint, 0.005), ("explicit Euler", euler, 0.1)):
        yield Row(f"{name}, cost at N = {counts[0]}", done[0].cost, "a curve", exact)
        yield Row(f"{name}, cost at N = {counts[-1]}", done[-1].cost, "a curve", exact, (1 + limit) * exact)
    times = [sum(each.seconds for each in done) for done in (euler, midpoint)]
    yield Row("ratio of times, Euler to midpoint", times[0] / times[1], "at least 1")


figure(
    "figure-3.3", "Figure 3.3", "One revolution: midpoint is at least as fast as explicit Euler.",
    TRANSFER + " --steps {N} --repeat 5", f"{TRANSFER} {EULERS} --steps {{N}} --repeat 5",
    remark="N = 10, 15, ..., 50.",
)(lambda run: _transfer_costs(run, 1, range(10, 51, 5)))  # fmt: skip
figure(
    "figure-3.4", "Figure 3.4", "Two revolutions: midpoint is at least as fast as explicit Euler.",
    TRANSFER + " --parameter revolutions=2 --steps {N} --repeat 5",
    f"{TRANSFER} {EULERS} --parameter revolutions=2 --steps {{N}} --repeat 5",
    remark="N = 10, 20, ..., 100.",
)(lambda run: _transfer_costs(run, 2, range(10, 101, 10)))  # fmt: skip


def reintegrated(done: dict[str, Vector]) -> tuple[Vector, float]:
    """Return radii at the nodes of the motion under the splined force, and the distance from the target at the end."""
    t, middle = done["t"], (done["t"][1:] + done["t"][:-1]) / 2
    push, gravity = CubicSpline(middle, done["u"][:, 0]), 0.40038

    def field(instant: float, z: Vector) -> list[float]:
        r, _, radial, angular = z
        forced = (float(push(instant)) / 100 - 2 * radial * angular) / r
        return [radial, angular, r * angular**2 - gravity / r**2, forced]

    start = [5.0, 0.0, 0.0, math.sqrt(gravity / 125)]
    path = solve_ivp(field, (0, t[-1]), start, "DOP853", t_eval=t, rtol=1e-11, atol=1e-11).y
    return path[0], math.hypot(path[0, -1] - 6, 6 * (path[1, -1] - done["q"][-1, 1]))


def _orbits(run: Runs, steps: int) -> Iterator[Row]:
    midpoint, euler = run(0, N=steps).arrays, run(1, N=steps).arrays
    radius, miss = reintegrated(midpoint)
    distance = np.abs(radius - midpoint["q"][:, 0]).max()
    yield Row("largest difference of radii, R-K and midpoint", distance, "indistinguishable", high=0.02)
    distance = np.abs(euler["q"][:, 0] - midpoint["q"][:, 0]).max()
    yield Row("largest difference of radii, Euler and midpoint", distance, "indistinguishable", high=0.3)
    yield Row("distance of R-K from the target at the end", miss, "", high=0.05)


figure(
    "figure-3.5", "Figure 3.5", "One revolution, N = 50: the orbits by midpoint, Euler and R-K are indistinguishable.",
    TRANSFER + " --steps {N}", f"{TRANSFER} {EULERS} --steps {{N}}",
    remark="R-K integrates the equations of motion with the splined force of midpoint. Radii are between 5 and 6.",
)(lambda run: _orbits(run, 50))  # fmt: skip
figure(
    "figure-3.6", "Figure 3.6", "Two revolutions, N = 100: the orbits by midpoint, Euler and R-K are "
    "indistinguishable.",
    TRANSFER + " --parameter revolutions=2 --steps {N}", f"{TRANSFER} {EULERS} --parameter revolutions=2 --steps {{N}}",
)(lambda run: _orbits(run, 100))  # fmt: skip


@figure(
    "figure-3.7", "Figures 3.7 to 3.9",
    "The optimal forces are noisy, and more time-steps are said to be necessary. Left panels: one revolution; right "
    "panels: two.",
    TRANSFER + " --controls nodal --parameter revolutions={R} --steps {N}",
    TRANSFER + " --parameter revolutions={R} --steps {N}",
    remark="The noise is the alternating mode of nodal controls (erratum `nodal-controls`). A converged optimum has it "
    "at any size. More steps do not remove it; controls on intervals do.",
    agreement=Agreement.DIFFERENT,
)  # fmt: skip
def _(run: Runs) -> Iterator[Row]:
    for revolutions, steps in ((1, 50), (2, 100), (1, 100), (2, 200), (1, 150), (2, 300)):
        nodal, interval = (run(number, R=revolutions, N=steps) for number in (0, 1))
        name = f"p = {revolutions}, N = {steps}"
        sizes = [np.abs(done.arrays["u"]).max() for done in (nodal, interval)]
        yield Row(f"{name}, largest force at nodes", sizes[0], "noise", low=10 * sizes[1])
        yield Row(f"{name}, largest force on intervals", sizes[1], "", high=0.1)
        if steps == 50:
            yield Row(f"{name}, cost with forces at nodes", float(nodal.record["cost"]), "", high=0.999 * interval.cost)
            yield Row(f"{name}, cost with forces on intervals", interval.cost, "")


# ---- Appendix A ----

HOVERCRAFT = "codegen solve problems/hovercraft.py"


@figure(
    "figure-A.1", "Figure A.1", "A hovercraft: forces f1 along and f2 across its heading, at a distance r from the "
    "centre.",
    "codegen show problems/hovercraft.py",
    remark="The figure is a sketch. The row compares work, force times velocity, with that of the body frame.",
)  # fmt: skip
def _(run: Runs) -> Iterator[Row]:
    assert run(0).status == 0
    f1, f2, theta, r, vx, vy, turn = sympy.symbols("f1 f2 theta r vx vy turn", real=True)
    along, across = vx * cos(theta) + vy * sin(theta), vy * cos(theta) - vx * sin(theta)
    printed = (cos(theta) * f1 - sin(theta) * f2) * vx + (sin(theta) * f1 + cos(theta) * f2) * vy - r * f2 * turn
    difference = sympy.simplify(printed - f1 * along - f2 * (across - r * turn))
    yield Row("difference of work", abs(float(difference)), "0", 0, 0)


@figure(
    "figure-A.2", "Figures A.2 and A.3",
    "Initial guesses for 3 and 5 craft: straight lines to a regular polygon on a circle of radius "
    "$R/(2\\sin(\\pi/H))$.",
    remark="The corners of the guess have sides R = 1 and the height 2 of the first corner.",
)  # fmt: skip
def _(run: Runs) -> Iterator[Row]:
    import codegen

    for craft in (3, 5):
        module: Any = codegen.load(codegen.build(ROOT / "problems/hovercraft.py", {"craft": craft}).path)
        grid = module.make_grid(20)
        guess = module.unpack(grid, module.initial_guess(grid))[1].reshape(21, craft, 3)
        ends = guess[-1, :, :2]
        sides = np.linalg.norm(ends - np.roll(ends, 1, axis=0), axis=1)
        yield Row(f"{craft} craft, largest deviation of a side from R", np.abs(sides - 1).max(), "0", high=1e-12)
        bend = np.abs(np.diff(guess, 2, axis=0)).max()
        yield Row(f"{craft} craft, deviation from straight lines", bend, "0", high=1e-12)


@figure(
    "figure-A.4", "Figures A.4 and A.5", "Optimal configurations of 3 and 5 craft, N = 20.",
    HOVERCRAFT + " --set craft={H} --steps 20", HOVERCRAFT + " --set craft={H} --controls nodal --steps 20",
    remark="Nodal controls, as in the thesis, find false optima (erratum `nodal-controls`). CasADi with IPOPT finds "
    "1053.518828 and 1821.353364 on the same programs with controls on intervals.",
)  # fmt: skip
def _(run: Runs) -> Iterator[Row]:
    for craft, optimum in ((3, 1053.518828), (5, 1821.353364)):
        done = run(0, H=craft)
        yield Row(f"{craft} craft, cost", done.cost, "a picture", optimum - 1e-5, optimum + 1e-5)
        ends = done.arrays["q"][-1].reshape(craft, 3)
        sides = np.linalg.norm(ends[:, :2] - np.roll(ends[:, :2], 1, axis=0), axis=1)
        yield Row(f"{craft} craft, largest deviation of a side from R", np.abs(sides - 1).max(), "0", high=1e-8)
        nodal = run(1, H=craft)
        yield Row(f"{craft} craft, cost with nodal controls", float(nodal.record["cost"]), "", high=optimum)


@claim(
    "rotation", "Section A.1",
    "If the rotation of the polygon is free, the problem is a global optimisation: solutions depend on the initial "
    "guess.",
    remark="Sixteen guesses for 3 craft: the polygon of the guess is turned by k/8 of a turn, in both orders of the "
    "craft. The rotation of the guess does not matter. The order of the craft does, and more so if the rotation is "
    "fixed.",
    agreement=Agreement.DIFFERENT,
)  # fmt: skip
def _(run: Runs) -> Iterator[Row]:
    import codegen

    for is_free, name in ((True, "free rotation"), (False, "fixed rotation")):
        solver, costs = codegen.compile(turned_hovercraft(is_free)), dict[tuple[int, int], float]()
        for way in (1, -1):
            for turn in range(8):
                parameters = {"turn": 2 * math.pi * turn / 8, "way": float(way)}
                done = codegen.solve(solver, steps=20, parameters=parameters)
                costs[way, turn] = round(float(done.cost or np.nan), 3) if done.solved else math.inf
        yield Row(f"{name}, guesses that lead to an optimum", sum(map(math.isfinite, costs.values())), "", low=12)
        optima = sorted({cost for cost in costs.values() if math.isfinite(cost)})
        yield Row(f"{name}, local optima", len(optima), "several" if is_free else "one", low=2)
        yield Row(f"{name}, least cost", optima[0], "", high=1053.52)
        yield Row(f"{name}, largest cost", optima[-1], "")
        same, there = len({cost for (way, _), cost in costs.items() if way == 1}), "several" if is_free else "one"
        yield Row(f"{name}, local optima from one order of the craft", same, there, 1, 1 if is_free else 4)


def turned_hovercraft(is_free: bool) -> Any:
    """Return the problem of 3 hovercraft with a free or fixed rotation, and a guess with the order `way` and `turn`."""
    import codegen
    from codegen.problem.sources import ProblemFile

    _, problem, _ = ProblemFile(ROOT / "problems/hovercraft.py").written({})
    (turn, way), body, t = codegen.parameters(turn=0.0, way=1.0), codegen.body_number(), codegen.time()
    angle, radius = sympy.pi + way * 2 * sympy.pi * body / 3 + turn, 1 / (2 * sin(sympy.pi / 3))
    places = {"x": (1 + body) * (1 - t) + t * (2 + radius * cos(angle)), "y": t * (2 + radius * sin(angle))}
    guess = {each: places.get(each.name, value) for each, value in problem.guess.items()}
    height = 5  # the condition on the height of craft 1, after three sides and two coordinates of the centre
    conditions = [each for i, each in enumerate(problem.end_conditions) if i != height or not is_free]
    return replace(problem, guess=guess, end_conditions=conditions)


@claim(
    "sym2fun", "Section A.2.8, sym2fun",
    "Symbolic Jacobians are printed as functions, with a variable for every craft and every node.",
    HOVERCRAFT + " --set craft={H} --steps {N}",
    remark="The generated module has loops over craft and nodes, so that N is an argument of the same module.",
)  # fmt: skip
def _(run: Runs) -> Iterator[Row]:
    import codegen

    lines = []
    for craft in (3, 5):
        costs = [run(0, H=craft, N=n).cost for n in (20, 200)]
        path = codegen.build(ROOT / "problems/hovercraft.py", {"craft": craft}).path
        lines.append(len(path.read_text(encoding="utf-8").splitlines()))
        yield Row(f"{craft} craft, lines of the module for every N", lines[-1], f"{5 * craft * 21} variables, N = 20")
        yield Row(f"{craft} craft, cost at N = 200 by that at N = 20", costs[1] / costs[0], "", 0.9, 1.1)
    yield Row("lines, 5 craft by 3 craft", lines[1] / lines[0], "grows with H", 0.95, 1.1)
