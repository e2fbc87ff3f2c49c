"""Chapters 4 to 6 and appendix B of the thesis: registration by landmarks.

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
from scipy.optimize import root
from sympy import Matrix, Rational

from thesis.entries import (
    REGISTRATION,
    ROOT,
    Agreement,
    Entry,
    Kind,
    Row,
    Runs,
    Vector,
    collected,
    disc_grid,
    euler_warp,
    geodesic,
    green,
    green_slope,
    least_area,
    order,
    points_file,
    trilobites,
)
from thesis.errata import averaged_cost, coded_green, laplacian, plate, x, y

REGISTRATIONS: list[Entry] = []
figure, table = collected(Kind.FIGURE, REGISTRATIONS), collected(Kind.TABLE, REGISTRATIONS)
claim, question = collected(Kind.CLAIM, REGISTRATIONS), collected(Kind.QUESTION, REGISTRATIONS, Agreement.ANSWERED)

LANDMARKS = "codegen solve problems/image_registration.py"
EULERS = "--scheme explicit-euler --method hamiltonian"
OWN_POINTS = (
    "The thesis's random landmarks cannot be drawn again without its version of Matlab. The files "
    "`tests/thesis/landmarks_N.csv` have landmarks from the same distribution."
)

# ---- Chapter 4 ----


@claim(
    "green", "Equation (4.1.6) and section 4.2",
    "G is biharmonic away from its source, vanishes on the circle with its normal derivative, and tends to "
    "$(|x|^2 - 1)^2/2$. Section 4.2 has its gradient.",
    remark="Erratum `green-constant` has the strength of the source.",
)  # fmt: skip
def _(run: Runs) -> Iterator[Row]:
    source, place = (Rational(3, 10), Rational(1, 5)), {x: Rational(-1, 2), y: Rational(1, 4)}
    kernel = plate((x, y), source)
    defect = laplacian(laplacian(kernel)).subs(place).evalf(30)
    yield Row("$\\Delta^2G$ at a point", abs(float(defect)), "0", high=1e-20)
    angle = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    circle, inner = np.stack([np.cos(angle), np.sin(angle)], axis=1), np.array([[0.3, 0.2]])
    yield Row("largest value on the circle", np.abs(green(circle, inner)).max(), "0", high=1e-14)
    yield Row("largest slope on the circle", np.abs(green_slope(circle, inner)).max(), "0", high=1e-14)
    near = green(inner, inner + 1e-9)[0] / (0.5 * (0.13 - 1) ** 2) - 1
    yield Row("limit at the source, relative difference", abs(near), "0", high=1e-8)
    close = inner[0], inner[0] + np.array([1e-9, 0.0])
    difference = coded_green(*close) / float(green(*close)) - 1
    yield Row("E.2.5 at points 1e-9 apart, relative difference", abs(difference), "", high=1e-13)
    a, b = np.array([0.3, 0.2]), np.array([-0.5, 0.25])
    ratio = (a @ a * (b @ b) - 2 * a @ b + 1) / ((a - b) @ (a - b))
    printed = (a * (b @ b) - b) * (1 - 1 / ratio) - (a - b) * np.log(ratio)
    yield Row("gradient of section 4.2, difference", np.abs(printed - green_slope(a, b)).max(), "0", high=1e-14)


@claim(
    "clamped-plate", "Section 4.1, clamped-plate and geodesic splines",
    "A clamped-plate spline is a diffeomorphism in the limit of small displacements only. Geodesic splines are "
    "diffeomorphisms; the thesis does not verify this.",
    remark="One landmark moves from the centre by d. The least determinant of the spline is $1 - 4d/e$, so that it "
    "folds beyond $d = e/4 = 0.68$. The map of the geodesic is integrated on a grid, by DOP853 at 1e-12.",
)  # fmt: skip
def _(run: Runs) -> Iterator[Row]:
    grid = disc_grid()
    for shift in (0.2, 0.8):
        value = green(grid, np.zeros(2)) / 0.5
        spline = grid + value[..., None] * np.array([shift, 0.0])
        limits = {"low": 0.01} if shift < 0.5 else {"high": -0.01}
        yield Row(f"d = {shift}, least area of a cell, spline", least_area(spline), "folds if large", **limits)
        momentum = np.array([[2 * math.atanh(shift), 0.0]])  # r = tanh(c t)
        inside = np.isfinite(grid).all(-1)
        mapped = np.full_like(grid, np.nan)
        ends, _, warped = geodesic(np.zeros((1, 2)), momentum, grid[inside], np.array([0.0, 1.0]))
        mapped[inside] = warped[-1]
        yield Row(f"d = {shift}, least area of a cell, geodesic", least_area(mapped), "no fold", low=1e-4)
        yield Row(f"d = {shift}, miss of the geodesic", abs(ends[-1, 0, 0] - shift), "", high=1e-10)


def arc(start: Vector, target: Vector, fractions: Vector) -> Vector:
    """Return points of the curved path of E.2.2: a hyperbolic line of the disc at constant speed."""
    a, b = complex(*start), complex(*target)
    turned = (b - a) / (1 - a.conjugate() * b)
    line = np.tanh(fractions * np.arctanh(abs(turned))) * turned / abs(turned)
    path = (line + a) / (1 + a.conjugate() * line)
    return np.stack([path.real, path.imag], axis=1)


@claim(
    "curved-path", "Section 4.2 and listing E.2.2", "The curved initial path is the solution for a single control "
    "point.",
    LANDMARKS + " --scheme dop853 --tolerance 1e-12 --set landmarks=tests/thesis/landmarks_1.csv",
)  # fmt: skip
def _(run: Runs) -> Iterator[Row]:
    done = run(0).arrays
    path = done["q"].reshape(-1, 2)
    difference = np.abs(arc(path[0], path[-1], done["t"]) - path).max()
    yield Row("largest difference from the solution", difference, "0", high=1e-9)


@claim(
    "dogleg", "Section 4.2, algorithms of fsolve",
    "The dogleg algorithm performs slightly better than the other algorithms of fsolve on the full nonlinear solve.",
    remark="scipy's hybr is a dogleg, lm is Levenberg-Marquardt; both have exact Jacobians. krylov and df-sane have "
    "none. Explicit Euler, N = 20.",
)  # fmt: skip
def _(run: Runs) -> Iterator[Row]:
    import codegen
    from codegen.problem.points import read_points

    module: Any = codegen.load(codegen.build(REGISTRATION, scheme="explicit-euler", method="full").path)
    for count in (3, 5):
        points = read_points(ROOT / points_file(count), 2)
        case = module.make_case(points.start, points.target, 20)
        first = module.first_unknowns(case)
        for method in ("hybr", "lm", "krylov", "df-sane"):
            calls = [0]

            def equations(z: Vector, case: Any = case, calls: list[int] = calls) -> Vector:
                calls[0] += 1
                return np.array(module.all_equations(case, z))

            derivative = (lambda z, case=case: module.all_equations_jacobian(case, z)) if len(method) < 5 else None
            options = {"maxiter": 200} if method == "krylov" else {"maxfev": 2000} if method == "df-sane" else {}
            found = root(equations, first, method=method, jac=derivative, options=options)
            left = np.abs(np.nan_to_num(module.all_equations(case, found.x), nan=np.inf)).max()
            limit = 1e-6 if method in ("hybr", "lm") else np.inf
            yield Row(f"nc = {count}, {method}, residual", left, "", high=limit)
            yield Row(f"nc = {count}, {method}, evaluations of equations", calls[0], "")
            if derivative is not None:
                limit = 2 if method == "hybr" else np.inf
                yield Row(
                    f"nc = {count}, {method}, evaluations of the Jacobian", found.njev, "least for dogleg", 0, limit
                )


# ---- Chapter 5 ----

ROUTES = {
    "stepping, Newton": "", "stepping, fsolve": " --driver fsolve", "stepping, fmin": " --driver fmin",
    "full, fsolve": " --method full --driver fsolve", "optimal control, Newton": " --method action",
    "optimal control, SLSQP": " --method action --driver slsqp",
}  # fmt: skip
"""The routes of solution, by their options."""


def route_commands(scheme: str, *names: str) -> tuple[str, ...]:
    """Return the commands of some routes."""
    options = f" --scheme {scheme} --steps {{N}} --set landmarks=tests/thesis/landmarks_{{nc}}.csv"
    return tuple(f"{LANDMARKS}{options}{ROUTES[name]}" for name in names)


@figure(
    "figure-5.1", "Figure 5.1", "Initial and final control points with curved initial paths, nc = 3, 4, 5.",
    remark=OWN_POINTS, agreement=Agreement.OTHER_DATA,
)  # fmt: skip
def _(run: Runs) -> Iterator[Row]:
    for count in (3, 4, 5):
        points = np.loadtxt(ROOT / points_file(count), delimiter=",", skiprows=1)
        fractions = np.linspace(0, 1, 11)
        worst = 0.0
        for row in points:
            line = row[:2] + fractions[:, None] * (row[2:] - row[:2])
            worst = max(worst, np.abs(arc(row[:2], row[2:], fractions) - line).max())
        yield Row(f"nc = {count}, largest distance of curved from straight paths", worst, "curved", 1e-4, 0.3)


def _routes(run: Runs, names: tuple[str, ...], own: float, action: float) -> Iterator[Row]:
    """Yield spreads of costs and paths over the routes, and the ratio of times."""
    for count in (3, 4, 5):
        done = {name: run(number, N=20, nc=count) for number, name in enumerate(names)}
        costs = {name: float(each.record["cost"]) for name, each in done.items()}
        first = costs["stepping, Newton"]
        worst = max(abs(c / first - 1) for name, c in costs.items() if not name.startswith("optimal"))
        yield Row(f"nc = {count}, stepping and full, relative spread of costs", worst, "close", high=own)
        worst = max(abs(c / first - 1) for name, c in costs.items() if name.startswith("optimal"))
        yield Row(f"nc = {count}, optimal control, relative difference of costs", worst, "close", high=action)
        best = done.pop("stepping, fsolve").seconds
        others = [each.seconds for name, each in done.items() if not name.endswith("Newton")]
        yield Row(f"nc = {count}, next best time by that of stepping with fsolve", min(others) / best, "above 1", low=1)
        paths = {name: each.arrays["q"] for name, each in done.items() if not name.endswith(("fmin", "SLSQP"))}
        worst = max(np.abs(path - paths["stepping, Newton"]).max() for path in paths.values())
        yield Row(f"nc = {count}, largest difference of paths", worst, "close", high=action)


MIDPOINT_ROUTES = ("stepping, Newton", "stepping, fsolve", "full, fsolve", "optimal control, Newton")

figure(
    "figure-5.2", "Figures 5.2 to 5.7",
    "Explicit Euler: the costs of all methods agree closely, and stepping with fsolve is the best. The figures also "
    "show the paths.",
    *route_commands("explicit-euler", *ROUTES), remark="N = 20.", agreement=Agreement.OTHER_DATA,
)(lambda run: _routes(run, tuple(ROUTES), 1e-8, 1e-3))  # fmt: skip
figure(
    "figure-5.8", "Figures 5.8 to 5.13",
    "Midpoint rule: the costs of three methods agree, and stepping is the fastest. For nc = 3 and 4 and large N, "
    "optimal control suddenly is faster and less accurate. The figures also show the paths.",
    *route_commands("midpoint", *MIDPOINT_ROUTES),
    remark="N = 20. `question-jumps` explains the jumps.", agreement=Agreement.OTHER_DATA,
)(lambda run: _routes(run, MIDPOINT_ROUTES, 1e-8, 1e-6))  # fmt: skip

THESIS_TIMES = {3: (157.5, 381.0, 1.705, 41.80), 4: (831.6, 786.6, 2.974, 79.81), 5: (7345.0, 1543.0, 4.663, 205.4)}
TABLE_ROUTES = ("optimal control, Newton", "full, fsolve", "stepping, fsolve", "stepping, fmin")


@table(
    "table-5.1", "Table 5.1", "Seconds of explicit Euler, N = 100: optimal control, full, stepping by fsolve and fmin.",
    *route_commands("explicit-euler", *TABLE_ROUTES),
    remark="The optimal control is by the generated Newton method, because SLSQP with its dense matrices takes "
    "minutes. The thesis used fmincon. " + OWN_POINTS,
    agreement=Agreement.OTHER_DATA,
)  # fmt: skip
def _(run: Runs) -> Iterator[Row]:
    for count, times in THESIS_TIMES.items():
        done = [run(number, N=100, nc=count) for number in range(4)]
        for name, there, each in zip(TABLE_ROUTES, times, done, strict=True):
            yield Row(f"nc = {count}, {name}, s", each.seconds, f"{there:g} s", high=there)


@claim(
    "symplectic-euler", "Section 5.1, symplectic Euler",
    "The costs of the symplectic Euler methods closely agree with those of explicit Euler, and they are not faster.",
    *(f"{LANDMARKS} --scheme {own} --steps {{N}} --set landmarks=tests/thesis/landmarks_{{nc}}.csv --repeat 5"
      for own in ("explicit-euler", "symplectic-euler")),
    f"{LANDMARKS} --scheme dop853 --tolerance 1e-12 --set landmarks=tests/thesis/landmarks_{{nc}}.csv",
)  # fmt: skip
def _(run: Runs) -> Iterator[Row]:
    for count in (3, 4, 5):
        explicit, symplectic = (run(number, N=100, nc=count) for number in (0, 1))
        exact = run(2, nc=count).cost
        difference = abs(symplectic.cost / explicit.cost - 1)
        yield Row(f"nc = {count}, relative difference of costs", difference, "close", high=0.02)
        yield Row(f"nc = {count}, error of explicit Euler", abs(explicit.cost / exact - 1), "", high=0.02)
        yield Row(f"nc = {count}, error of symplectic Euler", abs(symplectic.cost / exact - 1), "", high=0.02)
        yield Row(f"nc = {count}, time, symplectic by explicit", symplectic.seconds / explicit.seconds, "above 1")


@claim(
    "high-cost", "Section 5.1", "Optimal control is slow where the final cost is high.",
    remark="The five landmarks with displacements multiplied by a; explicit Euler, N = 20, SLSQP as fmincon and the "
    "generated Newton method.",
    agreement=Agreement.OTHER_DATA,
)  # fmt: skip
def _(run: Runs) -> Iterator[Row]:
    import codegen
    from codegen.problem.points import read_points

    points = read_points(ROOT / points_file(5), 2)
    counts = []
    for factor in (0.25, 0.5, 1.0, 1.5):
        scaled = replace(points, target=points.start + factor * (points.target - points.start))
        options: dict[str, Any] = {"scheme": "explicit-euler", "method": "action", "steps": 20, "points": scaled}
        slow = codegen.solve(REGISTRATION, "slsqp", **options)
        fast = codegen.solve(REGISTRATION, "newton", **options)
        counts.append(slow.iterations)
        yield Row(f"a = {factor}, cost", float(fast.cost or np.nan), "")
        yield Row(f"a = {factor}, iterations of SLSQP", slow.iterations, "grow with the cost")
        yield Row(f"a = {factor}, iterations of Newton", fast.iterations, "")
    yield Row("iterations of SLSQP, largest by least cost", counts[-1] / counts[0], "above 1", low=1.0)


@claim(
    "adaptive-codes", "Section 5.3, footnote", "ode113 appears to perform better than ode45, but the difference is "
    "small.",
    LANDMARKS + " --scheme lsoda --tolerance 1e-6 --repeat 3", LANDMARKS + " --scheme dop853 --tolerance 1e-6 "
    "--repeat 3",
    LANDMARKS + " --scheme dop853 --tolerance 1e-13",
    remark="The forty landmarks. LSODA is in place of ode113, and DOP853, a Runge-Kutta code, of ode45.",
    agreement=Agreement.OTHER_DATA,
)  # fmt: skip
def _(run: Runs) -> Iterator[Row]:
    exact = run(2).cost
    for number, name in enumerate(("LSODA", "DOP853")):
        done = run(number)
        yield Row(f"{name}, true error", abs(done.cost - exact), "", high=1e-5)
        yield Row(f"{name}, ms", 1e3 * done.seconds, "similar")


@figure(
    "figure-5.14", "Figures 5.14 to 5.16",
    "Stepping by midpoint, ode113 and explicit Euler: ode113 is as fast as Euler and as accurate as midpoint.",
    *(f"{LANDMARKS} --scheme {own} --set landmarks=tests/thesis/landmarks_{{nc}}.csv --repeat 5"
      for own in ("midpoint --steps 100", "lsoda --tolerance 1e-6", "explicit-euler --steps 100")),
    LANDMARKS + " --scheme dop853 --tolerance 1e-12 --set landmarks=tests/thesis/landmarks_{nc}.csv",
    remark="LSODA of scipy, an Adams code as ode113, in its place. N = 100. Its accuracy is as stated. It is slower "
    "than explicit Euler, whose steps are compiled here.",
    agreement=Agreement.DIFFERENT,
)  # fmt: skip
def _(run: Runs) -> Iterator[Row]:
    for count in (3, 4, 5):
        exact = run(3, nc=count).cost
        for number, name in enumerate(("midpoint", "LSODA", "explicit Euler")):
            done = run(number, nc=count)
            limit = 1e-2 if name == "explicit Euler" else 1e-4
            yield Row(f"nc = {count}, {name}, relative error of the cost", abs(done.cost / exact - 1), "", high=limit)
            yield Row(f"nc = {count}, {name}, ms", 1e3 * done.seconds, "slowest" if number == 0 else "")


@table(
    "table-5.2", "Table 5.2",
    "Forty control points, N = 10: seconds and absolute errors of the cost by midpoint, ode113 and explicit Euler. "
    "Benchmark cost 1.0089.",
    LANDMARKS + " --scheme midpoint --steps 10", LANDMARKS + " --scheme lsoda --tolerance 1e-2",
    LANDMARKS + " --scheme explicit-euler --steps 10", LANDMARKS + " --scheme dop853 --tolerance 1e-13",
    remark="The thesis's points are not published, so these are the landmarks of two trilobites. `as printed` is the "
    "distance from the benchmark of the thesis (erratum `benchmark-cost`), in which midpoint reads four times its true "
    "error.",
    agreement=Agreement.OTHER_DATA,
)  # fmt: skip
def _(run: Runs) -> Iterator[Row]:
    exact = run(3)
    q_t, p_t = (exact.arrays[name].reshape(-1, 40, 2) for name in "qp")
    benchmark = averaged_cost(q_t, p_t)
    yield Row("benchmark, exact", exact.cost, "", 1.0143734005, 1.0143734006)
    yield Row("benchmark, as in the thesis", benchmark, "1.0089")
    printed = ((9399, 1.729e-3), (63.30, 2.803e-6), (19.14, 3.751e-3))
    for number, (name, (time, error)) in enumerate(zip(("midpoint", "LSODA", "explicit Euler"), printed, strict=True)):
        done = run(number)
        cost = done.cost
        if name == "LSODA":  # the thesis evaluates ode113 in the same way as its benchmark
            cost = averaged_cost(*(done.arrays[each].reshape(-1, 40, 2) for each in "qp"))
        yield Row(f"{name}, s", done.seconds, f"{time:g} s", high=time)
        yield Row(f"{name}, error as printed", abs(cost - benchmark), f"{error:.4g}", high=0.02)
        yield Row(f"{name}, true error", abs(done.cost - exact.cost), "", high=0.02)


@figure(
    "figure-5.17", "Figure 5.17",
    "ode113 at tolerances from 1e-6 to 1e-2, forty points: the error of the cost never exceeds 4e-6.",
    LANDMARKS + " --scheme lsoda --tolerance {E}", LANDMARKS + " --scheme dop853 --tolerance {E}",
    remark="`as printed` compares both costs by the midpoint rule on the nodes, as E.5.3 does. The true error compares "
    "2 H. LSODA is in place of ode113, and its errors exceed 4e-6 at tolerances of 1e-4 and more.",
    agreement=Agreement.DIFFERENT,
)  # fmt: skip
def _(run: Runs) -> Iterator[Row]:
    exact = run(1, E=1e-13)

    def shaped(done: Any) -> list[Vector]:
        return [done.arrays[name].reshape(-1, 40, 2) for name in "qp"]

    benchmark = averaged_cost(*shaped(exact))
    for tolerance in (1e-6, 1e-5, 1e-4, 1e-3, 1e-2):
        done = run(0, E=tolerance)
        limits = {"high": 4e-6} if tolerance < 5e-5 else {"low": 4e-6}
        error = abs(averaged_cost(*shaped(done)) - benchmark)
        yield Row(f"{tolerance:g}, error as printed", error, "at most 4e-6", **limits)
        yield Row(f"{tolerance:g}, true error", abs(float(done.record["cost"]) - exact.cost), "")
        yield Row(f"{tolerance:g}, ms", 1e3 * done.seconds, "60 to 140 s")


@figure(
    "figure-5.18", "Figure 5.18", "Optimal paths of ode113 on the forty points, magnified.",
    LANDMARKS + " --scheme dop853 --tolerance 1e-13 --plot {folder}/paths.png",
    remark="The true paths are integrated again from their initial momenta, by numpy and scipy.",
    agreement=Agreement.OTHER_DATA,
)  # fmt: skip
def _(run: Runs) -> Iterator[Row]:
    done = run(0, folder=run.folder).arrays
    q_t, p_t = (done[name].reshape(-1, 40, 2) for name in "qp")
    again, _, _ = geodesic(q_t[0], p_t[0], np.zeros((0, 2)), done["t"])
    yield Row("largest difference of paths", np.abs(again - q_t).max(), "a picture", high=1e-8)
    yield Row("largest distance from a target", np.abs(again[-1] - trilobites()[1]).max(), "", high=1e-8)


# ---- Appendix B ----


@claim(
    "euler-poincare", "Section B.1",
    "$\\mathrm{ad}^*_v m = v\\cdot\\nabla m + \\nabla v^T m + (\\mathrm{div}\\,v)m$, from $\\langle\\mathrm{ad}^*_v m, "
    "u\\rangle = -\\int m\\cdot[v, u]$ for every test field u that vanishes on the boundary.",
    remark="Exact integrals of random polynomials over a square. Without its last term the formula fails.",
)  # fmt: skip
def _(run: Runs) -> Iterator[Row]:
    generator = np.random.default_rng(2)

    def polynomial() -> sympy.Expr:
        coefficients = generator.integers(-4, 5, (3, 3)).tolist()
        return sum(coefficients[a][b] * x**a * y**b for a in range(3) for b in range(3))

    v, m, u = (Matrix([polynomial(), polynomial()]) for _ in range(3))
    u = u * x * (1 - x) * y * (1 - y)
    bracket = u.jacobian([x, y]) * v - v.jacobian([x, y]) * u
    transported = m.jacobian([x, y]) * v + v.jacobian([x, y]).T * m
    spread = v.jacobian([x, y]).trace() * m
    for name, claimed, limits in (
        ("defect", transported + spread, {"high": 0.0}), ("defect without div v", transported, {"low": 1e-3})
    ):  # fmt: skip
        integrand = (claimed.dot(u) + m.dot(bracket)).expand()
        yield Row(name, abs(float(sympy.integrate(integrand, (x, 0, 1), (y, 0, 1)))), "0", **limits)


@claim(
    "particle-ansatz", "Section B.2", "The particle ansatz is a weak solution of the Euler-Poincare equations.",
    remark="Two particles, any symmetric kernel and any test function, by computer algebra; each term is needed.",
)  # fmt: skip
def _(run: Runs) -> Iterator[Row]:
    import sys

    sys.path.append(str(ROOT / "tests" / "evidence"))
    from weak_solution import is_zero, weak_defect

    yield Row("defect vanishes (1 is true)", is_zero(weak_defect()), "0", 1, 1)
    for term in ("rate", "advection", "stretching", "divergence"):
        yield Row(f"defect without {term} vanishes", is_zero(weak_defect(particles=1, without=term)), "", 0, 0)


# ---- Chapter 6 ----


@question(
    "question-paths", "Chapter 6", "Can better initial paths be generated?",
    LANDMARKS + " --method full --scheme explicit-euler --steps 20 --set path={path}",
    LANDMARKS + " --method full --scheme explicit-euler --steps 20 --set path={path} "
    "--set landmarks=tests/thesis/landmarks_5.csv",
    remark="Curved paths save one iteration at most, of Newton's method on all nodes. `codegen report "
    "problems/image_registration.py --out DIR` compares three more initial paths.",
)  # fmt: skip
def _(run: Runs) -> Iterator[Row]:
    for number, name in enumerate(("forty landmarks", "five landmarks")):
        curved, straight = (run(number, path=path) for path in ("arc", "straight"))
        for done in (curved, straight):
            assert done.record["status"] == "solved"
        saved = straight.record["iterations"] - curved.record["iterations"]
        yield Row(f"{name}, iterations from curved paths", curved.record["iterations"], "")
        yield Row(f"{name}, iterations that curved paths save", saved, "some", 0, 1)


@question(
    "question-dimension", "Chapter 6", "How do the methods scale with the number of spatial dimensions?",
    remark="100 random landmarks with smooth displacements in the disc and in the ball, explicit Euler, N = 10. Only "
    "the operations of a pair of landmarks grow.",
)  # fmt: skip
def _(run: Runs) -> Iterator[Row]:
    import codegen
    from codegen.problem.points import PointSet

    times = []
    for dimension in (2, 3):
        generator = np.random.default_rng(1)
        start = generator.normal(size=(100, dimension))
        radius = 0.8 * generator.random((100, 1)) ** (1 / dimension)
        start *= radius / np.linalg.norm(start, axis=1, keepdims=True)
        target = start + 0.1 * (1 - radius**2) ** 2 * np.sin(2 * np.roll(start, 1, axis=1))
        points = PointSet(start, target, np.zeros(100))
        options: dict[str, Any] = {"scheme": "explicit-euler", "arguments": {"dimension": dimension}, "repeat": 3}
        done = codegen.solve(REGISTRATION, points=points, **options)
        yield Row(f"dimension {dimension}, residual", done.residual, "", high=1e-8)
        times.append(done.seconds_solve)
    yield Row("ratio of times, space to plane", times[1] / times[0], "", 0.5, 6)


@question(
    "question-smoothness", "Chapter 6", "How many time-steps does a warp of a given degree of smoothness need?",
    remark="The landmarks of the trilobites with displacements multiplied by a, explicit Euler. Errors are those of a "
    "warped grid against 640 steps. They fall as 1/N, and five steps fold no cell.",
)  # fmt: skip
def _(run: Runs) -> Iterator[Row]:
    import codegen
    from codegen.problem.points import PointSet

    start, target = trilobites()
    grid = disc_grid(31)
    inside = np.isfinite(grid).all(-1)
    for factor in (1.0, 2.0):
        points = PointSet(start, start + factor * (target - start), np.zeros(40))
        warps = {}
        for steps in (640, 5, 10, 20, 40, 80):
            done = codegen.solve(REGISTRATION, scheme="explicit-euler", steps=steps, points=points)
            q_t, p_t = (each.reshape(steps + 1, 40, 2) for each in (done.q, done.p))
            warps[steps] = np.full_like(grid, np.nan)
            warps[steps][inside] = euler_warp(q_t, p_t, grid[inside])
        exact = warps.pop(640)
        errors = {steps: np.nanmax(np.abs(warp - exact)) for steps, warp in warps.items()}
        yield Row(f"a = {factor}, error with N = 10", errors[10], "")
        yield Row(f"a = {factor}, order", order(list(errors), list(errors.values())), "1", 0.8, 1.3)
        yield Row(f"a = {factor}, least area of a cell with N = 5", least_area(warps[5]), "", low=1e-3)


@question(
    "question-jumps", "Chapter 6",
    "What happens inside fmincon in Figures 5.8 and 5.9, where it suddenly is faster and less accurate?",
    remark="SLSQP on the midpoint rule, nc = 3. With momenta on nodes only their averages matter, so that optima are "
    "not isolated. At the tolerance 1e-6 of the thesis the optimiser stops as soon as the cost changes little; at "
    "1e-14 it goes on.",
)  # fmt: skip
def _(run: Runs) -> Iterator[Row]:
    from codegen.evidence.report.landmark_cases import JUMPS_SECTION, Minimisation, jump_cases
    from codegen.evidence.report.store import Settings, Store

    counts = (10, 20, 30)
    settings = Settings(REGISTRATION, (3,), counts, limit=1e9)
    wanted = {Minimisation("nodes", "curved", own).case(3, n): (own, n) for own in (1e-6, 1e-14) for n in counts}
    for case in jump_cases(settings, Store(run.folder / "jumps.jsonl")):
        if case.section == JUMPS_SECTION and case.name.startswith("null space"):
            yield Row("directions without effect, momenta on nodes", case.measure()["nodes"], "", 6, 6)
        elif case.name in wanted:
            values, (tolerance, steps) = case.measure(), wanted[case.name]
            name = f"tolerance {tolerance:g}, N = {steps}"
            is_loose = tolerance > 1e-10
            there = ("less accurate for large N", "faster for large N") if is_loose else ("", "")
            limits = {"low": 1e-6} if is_loose else {"high": 1e-7}
            yield Row(f"{name}, error of the cost", values["error"], there[0], **limits)
            limits = {"high": 50} if is_loose else {"low": 100}
            yield Row(f"{name}, iterations", values["iterations"], there[1], **limits)


@question(
    "question-midpoint", "Chapter 6", "Can the midpoint stepping be made more efficient?",
    LANDMARKS + " --scheme midpoint --steps 10 --repeat 5", LANDMARKS + " --scheme explicit-euler --steps 10 --repeat "
    "5",
    remark="Yes. Forty landmarks. Newton's method with generated derivatives replaces a root finder in a root finder.",
)  # fmt: skip
def _(run: Runs) -> Iterator[Row]:
    ratio = run(0).seconds / run(1).seconds
    yield Row("ratio of times, midpoint to explicit Euler", ratio, f"{9399 / 19.14:.0f}, Table 5.2", high=100)


@question(
    "question-orders", "Chapter 6", "How do higher order explicit and symplectic methods compare?",
    *(f"{LANDMARKS} --scheme {own} --steps 10 --repeat 5"
      for own in ("explicit-euler", "midpoint", "stormer-verlet", "rk4", "yoshida-4-of-midpoint")),
    LANDMARKS + " --scheme dop853 --tolerance 1e-13",
    remark="Forty landmarks, N = 10, true errors of the cost. The explicit rk4 has the least error, in less time than "
    "midpoint.",
)  # fmt: skip
def _(run: Runs) -> Iterator[Row]:
    exact = run(5).cost
    names = ("explicit Euler", "midpoint", "Stormer-Verlet", "rk4", "Yoshida 4 of midpoint")
    for number, name in enumerate(names):
        done = run(number)
        limit = {"explicit Euler": 1e-2, "rk4": 5e-6}.get(name, 1e-3)
        yield Row(f"{name}, error", abs(done.cost - exact), "", high=limit)
        yield Row(f"{name}, ms", 1e3 * done.seconds, "")


@question(
    "question-compiled", "Chapter 6", "How fast is an optimised version in C or Fortran?",
    LANDMARKS + " --scheme explicit-euler --steps 10 --repeat 20", LANDMARKS + " --scheme explicit-euler --steps 100",
    remark="The modules are compiled to machine code by numba, forty landmarks. The machine is 20 years younger, too.",
)  # fmt: skip
def _(run: Runs) -> Iterator[Row]:
    for number, steps in enumerate((10, 100)):
        there = "19140" if steps == 10 else ""
        yield Row(f"explicit Euler, N = {steps}, ms", 1e3 * run(number).seconds, there, high=19140)
