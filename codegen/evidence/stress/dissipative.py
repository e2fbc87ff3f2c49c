"""Stiff motions that decay: damping at infinity and order reduction of every scheme, reactions, actuators, contacts.

Steps of a linear problem follow from the table of a scheme, without generated code. Other motions are compared with
scipy's Radau on rates written by hand.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import partial
from types import ModuleType
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp
from scipy.linalg import expm, solve_triangular

from codegen.discretise.schemes import find, of_method
from codegen.discretise.schemes.base import FIRST_ORDER, Scheme
from codegen.evidence.stress.cases import Case
from codegen.evidence.stress.motions import setup
from codegen.evidence.stress.systems import stability_function, table_of
from codegen.solving.results.result import Result

Vector = np.ndarray[Any, np.dtype[np.float64]]
COMPARED = ("implicit-euler", "radau-5", "sdirk-4")  # L-stable schemes for problems that take longer to compile
BOUNDS = {
    "robertson": (400, 3e-3, 3e-9, 3e-7),
    "van_der_pol": (100, 3e-3, 1e-7, 1e-6),
    "hires": (2000, 0.01, 1e-7, 1e-5),
    "actuator": (200, 0.2, 1e-7, 1e-6),
    "contact": (4000, 5e-3, 3e-9, 1e-7),
}
"""The problems' own steps, and the largest errors of COMPARED there: up to four times the errors at first."""


def dissipative_cases() -> Iterator[Case]:
    """Yield cases: Prothero and Robinson's problem by every scheme, and reactions, an actuator and a contact."""
    for scheme in of_method(FIRST_ORDER):
        module = setup("prothero_robinson", (None, scheme.name))
        factor = abs(stability_function(scheme, -1e4))
        kind = (
            "L-stable"
            if factor < 1e-3
            else "A-stable without damping"
            if factor < 1.0 + 1e-6
            else "unstable at this step"
        )
        yield Case(
            "fast decay, h lambda = -1e4, ten steps", "dissipative", module, "accurate",
            f"{kind}: a step multiplies a deviation by |R| = {factor:.3g}, as the table says", 10,
            (("rate", -1e5), ("duration", 1.0), ("start", (("y", 2.0),))), reference="by_table", bound=1e-9,
            h_omega=1e4,
        )  # fmt: skip
        for rate in (1.0, 1e3, 1e6):
            errors = [float(np.abs(followed(scheme, -rate, n, 1.0) - np.cos(np.linspace(0.0, 1.0, n + 1))).max())
                      for n in (20, 40)]  # fmt: skip
            if not errors[0] < 0.5:
                continue
            order = math.log2(errors[0] / errors[1]) if errors[1] > 1e-14 else math.nan
            reduced = f"order {order:.2g} of {scheme.order}" if order < 90 else "rounding errors only"
            yield Case(
                f"slow motion with a fast decay, lambda = -{rate:g}", "dissipative", module, "accurate",
                f"by the table: {reduced}", 20, (("rate", -rate), ("duration", 1.0)), reference="slow_motion",
                bound=1.01 * errors[0] + 1e-12, h_omega=rate / 20.0,
            )  # fmt: skip
    for problem, (steps, *bounds) in BOUNDS.items():
        for name, bound in zip(COMPARED, bounds, strict=True):
            yield Case(
                problem.replace("_", " "), "dissipative", setup(problem, (None, name)), "accurate",
                f"L-stable, order {find(name, FIRST_ORDER).order}", steps, reference="by_radau", bound=bound,
            )  # fmt: skip


def followed(scheme: Scheme, rate: float, steps: int, start: float) -> Vector:
    """Return y at all nodes of Prothero and Robinson's problem on [0, 1], from the table of a scheme."""
    a, b = (np.array(each, dtype=float) for each in table_of(scheme))
    c, h, y = a.sum(axis=1), 1.0 / steps, [start]
    matrix = np.eye(len(b)) - h * rate * a
    solve = partial(solve_triangular, lower=True, check_finite=False) if not np.triu(a).any() else np.linalg.solve
    for k in range(steps):
        t = (k + c) * h
        with np.errstate(over="ignore", invalid="ignore"):  # explicit schemes beyond their limit
            slopes = solve(matrix, rate * (y[-1] - np.cos(t)) - np.sin(t))
            y.append(float(y[-1] + h * b @ slopes))
    return np.array(y)


def by_table(module: ModuleType, case: Case, result: Result) -> float:
    """Return the difference from the table's steps, relative to the largest of the motion."""
    values = dict(case.values)
    exact = followed(find(result.scheme, FIRST_ORDER), values["rate"], result.steps, 2.0)
    return float(np.abs(result.q[:, 0] - exact).max() / np.abs(exact).max())


def slow_motion(module: ModuleType, case: Case, result: Result) -> float:
    """Return the largest difference from cos t."""
    return float(np.abs(result.q[:, 0] - np.cos(result.t)).max())


def robertson(t: float, y: Vector) -> Vector:
    """Return the rates of three reactions."""
    slow, fast, back = 0.04 * y[0], 3e7 * y[1] ** 2, 1e4 * y[1] * y[2]
    return np.array([back - slow, slow - back - fast, fast])


def hires(t: float, y: Vector) -> Vector:
    """Return the rates of eight reactions."""
    matrix = np.zeros((8, 8))
    for i, j, value in (
        (0, 0, -1.71), (0, 1, 0.43), (0, 2, 8.32), (1, 0, 1.71), (1, 1, -8.75), (2, 2, -10.03), (2, 3, 0.43),
        (2, 4, 0.035), (3, 1, 8.32), (3, 2, 1.71), (3, 3, -1.12), (4, 4, -1.745), (4, 5, 0.43), (4, 6, 0.43),
        (5, 3, 0.69), (5, 4, 1.71), (5, 5, -0.43), (5, 6, 0.69), (6, 6, -1.81), (7, 6, 1.81),
    ):  # fmt: skip
        matrix[i, j] = value
    rates = matrix @ y
    rates[0] += 0.0007
    rates[5:] += np.array([-1.0, 1.0, -1.0]) * 280.0 * y[5] * y[7]
    return np.asarray(rates)


def contact(t: float, y: Vector) -> Vector:
    """Return velocity and acceleration of a mass above a spring with a damper."""
    depth = (math.hypot(y[0], 1e-4) - y[0]) / 2.0
    return np.array([y[1], 1e6 * depth - 1e3 * depth / (depth + 1e-4) * y[1] - 1.0])


RATES: dict[str, Callable[[float, Vector], Vector]] = {
    "robertson": robertson,
    "hires": hires,
    "contact": contact,
    "van_der_pol": lambda t, y: np.array([y[1], 1000.0 * ((1.0 - y[0] ** 2) * y[1] - y[0])]),
}


def by_radau(module: ModuleType, case: Case, result: Result) -> float:
    """Return the largest error of a component at the end, relative to its largest value on the motion."""
    problem, t = case.setup.problem, result.t
    if problem == "actuator":
        matrix = np.array([[0.0, 1.0, 0.0, 0.0], [-1.0, 0.0, 1.0, 0.0], [0.0, 0.0, -1e9, 1e9], [0.0, 0.0, 0.0, 0.0]])
        exact = (expm(t[-1] * matrix) @ np.array([0.0, 0.0, 0.0, 1.0]))[:3]
    else:
        options = {"rtol": 1e-10, "atol": 1e-15}
        exact = solve_ivp(RATES[problem], (0.0, t[-1]), result.q[0], "Radau", **options).y[:, -1]
    return float((np.abs(result.q[-1] - exact) / np.abs(result.q).max(axis=0)).max())
