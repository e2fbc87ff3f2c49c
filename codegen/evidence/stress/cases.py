"""Stress cases as data: a case, its measurement, and its outcome, which passes if it is honest and expected."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

from codegen.runtime.record import Form
from codegen.runtime.search import point
from codegen.runtime.search.scaling import scaled_grid
from codegen.solving.drivers import DRIVERS
from codegen.solving.loading import Matrix, SimulateModule, Vector
from codegen.solving.results.control import bound_distances, held_at_bounds
from codegen.solving.results.motions import rounding_level
from codegen.solving.results.result import STATUSES, Result

PROBLEMS = Path(__file__).with_name("problems.py")
Values = tuple[tuple[str, Any], ...]
"""Names and values of keyword arguments; a value may itself be Values, which stands for a dict."""

OUTCOMES = {
    "accurate": "solved, and the error is below what the order of the scheme promises at this step",
    "bounded": "solved; no error is promised (chaos, or steps too long for the fast motion), the energy is bounded",
    "unsuitable": "the steps' equations hold, but the energy has run away, which the summary of `solve` reports",
    "refused": "a named failure, or a typed error, that says what is wrong and what to try",
}
"""The honest outcomes of a case, which pass if they are expected."""

DEFECTS = {
    "false solved": "reported as solved, though the equations do not hold or the error is beyond what is promised",
    "not a number": "reported as solved with NaN or infinite results",
    "hang": "no answer within the time limit",
    "untyped error": "an exception that names no remedy, a crash, or a status that is not documented",
    "unexpected": "honest, but not what is expected of this case",
}
"""The outcomes that always fail."""


@dataclass(frozen=True)
class Setup:
    """The inputs of a module: a problem file, a scheme and a method (None: default), and arguments of problem()."""

    file: Path
    scheme: str | None = None
    method: str | None = None
    arguments: Values = ()

    @property
    def problem(self) -> str:
        """Return the name of the problem."""
        return str(dict(self.arguments)["system"]) if self.file == PROBLEMS else self.file.stem

    @property
    def label(self) -> str:
        """Return the scheme as in tables, with its method if it is variational."""
        name = self.scheme or "midpoint"
        return f"{name}, variational" if self.method == "variational" else name


@dataclass(frozen=True)
class Truth:
    """The exact motion of a user's own problem: states (M, 2n) at M times, and what is known along it.

    `sizes` are the sizes of components. `energy` is the largest variation of the potential or size of the kinetic
    energy, NaN if the energy is not conserved. `conserved` masks components that are constant. `rate` is the largest
    modulus of an eigenvalue of the linearised motion. For optimal control all are empty.
    """

    times: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    states: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 0)))
    sizes: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    conserved: NDArray[np.bool_] = field(default_factory=lambda: np.empty(0, bool))
    energy: float = math.nan
    rate: float = math.nan


def euler_field(module: SimulateModule, duration: float) -> Callable[[float, Vector], Vector]:
    """Return the vector field f(t, z) of a problem from one step of explicit Euler: (z_1 - z_0)/h, for a long h.

    The step is linear in h, so that a long step loses no digits in the subtraction.
    """
    grid = module.make_grid(1, duration=2.0 ** math.ceil(math.log2(duration)))
    return lambda t, z: np.asarray((module.step(grid, z, t) - z) / grid.h)


def component_sizes(module: SimulateModule, states: Matrix) -> Vector:
    """Return the sizes of all components of the state, shape (2n,).

    These are the largest position for every position, and the largest momentum for every momentum. Every state of
    first-order dynamics has a size of its own.
    """
    size = np.abs(states).max(axis=0)
    if module.metadata.form == Form.FIRST_ORDER:
        return np.where(size > 0.0, size, 1.0)
    half = size.size // 2
    return np.repeat([size[:half].max() or 1.0, size[half:].max() or 1.0], half)


@dataclass(frozen=True)
class Case:
    """One solve of a module with run-time values, and the expected outcome.

    `reason` explains the expected outcome `expect`; the outcomes `allowed` pass as well. `values` are arguments of the
    solve, `every` and `doublings` options of `api.solve`. `reference` names the function that computes the error (see
    `measure.REFERENCES`). `bound` is the largest error that the order of the scheme promises, or NaN without a promise.
    `drift` is the largest relative change of energy that counts as bounded. `h_omega` is the time step times the
    largest frequency. `textbook` asks for the residuals of the scheme's textbook equations in extended precision,
    `limit` for the largest stable step. `points` are rows of start and target, `noise` perturbs the initial guess of an
    optimisation, `seconds` is the time limit. A user's own problem has a `truth`, and a number of noisy `guesses`.
    """

    name: str
    family: str
    setup: Setup
    expect: str
    reason: str
    steps: int = 100
    values: Values = ()
    every: int = 1
    driver: str = "newton"
    doublings: int = 0
    points: tuple[tuple[float, ...], ...] = ()
    noise: float = 0.0
    reference: str = ""
    bound: float = math.nan
    drift: float = 0.1
    h_omega: float = math.nan
    textbook: bool = False
    limit: bool = False
    allowed: tuple[str, ...] = ()
    seconds: float = 120.0
    truth: Truth | None = None
    guesses: int = 0

    @property
    def expected(self) -> tuple[str, ...]:
        """Return the outcomes that pass; a refusal passes also if "unsuitable" is expected: both are honest."""
        refused = ("refused",) if self.expect == "unsuitable" and "refused" not in self.allowed else ()
        return (self.expect, *self.allowed, *refused)


@dataclass(frozen=True)
class Measurement:
    """The observations of a worker; NaN stands for quantities that were not measured or do not exist.

    `error` is the error against the reference, `announced` the relative error that a doubled grid shows. `residual` is
    the residual of all equations, evaluated outside the solver, or for an optimum the distance from the exact root of
    its equations; `tolerance` is its limit. `textbook` is the residual in extended precision, in rounding errors of
    double precision. `drift` is the largest relative change of energy; first-order dynamics have no energy. `others`
    counts noisy guesses that lead to other optima. `stable_below` is the largest stable step times frequency.
    """

    status: str = ""
    message: str = ""
    refusal: str = ""
    exception: str = ""
    finite: bool = True
    error: float = math.nan
    announced: float = math.nan
    residual: float = math.nan
    tolerance: float = math.nan
    textbook: float = math.nan
    drift: float = math.nan
    has_energy: bool = True
    stable_below: float = math.nan
    failures: int = 0
    others: int = 0
    iterations: int = 0
    seconds: float = math.nan
    hung: bool = False


@dataclass(frozen=True)
class Row:
    """A case, its measurement, and the verdict: an outcome or defect, True if it passes, and a sentence."""

    case: Case
    measurement: Measurement
    outcome: str
    passed: bool
    text: str


TEXTBOOK = 100.0  # the largest accepted residual of the textbook equations, in rounding errors of double precision
HONEST = 3.0  # the largest error in units of the error that a result announces
TWICE = 2.0
"""The largest error, relative to the size of each component, of a motion that stays where the exact motion is."""
SIGN = 0.01
"""The relative change of energy above which the summary of a simulation reports that the time step is too long."""


def classify(case: Case, run: Measurement) -> Row:
    """Return the row of a case with its outcome and verdict."""
    outcome, text = _outcome(case, run)
    passed = outcome in case.expected
    if not passed and outcome in OUTCOMES:
        text = f"{outcome}, expected {' or '.join(case.expected)}: {text}"
        outcome = "unexpected"
    return Row(case, run, outcome, passed, text)


def _outcome(case: Case, run: Measurement) -> tuple[str, str]:
    if run.hung:
        return "hang", run.message or f"no answer within {case.seconds:g} s"
    if run.exception:
        return "untyped error", run.exception
    if run.refusal:
        return "refused", run.refusal
    if run.status not in STATUSES:
        return "untyped error", f"the status {run.status!r} is not documented"
    if case.truth is not None and case.limit:
        text = f"{_stability(case, run)}, expected {case.bound:.3g} or more"
        return ("bounded" if run.stable_below >= 0.999 * case.bound else "unsuitable"), text
    if run.status != "solved":
        if not run.message:
            return "untyped error", f"the status {run.status!r} comes without a message"
        if case.h_omega > run.stable_below:
            return "unsuitable", f"unsuitable, {_stability(case, run)}: {run.message}"
        return "refused", run.message
    if not run.finite:
        return "not a number", "solved, with results that are infinite or no numbers"
    if not run.residual <= run.tolerance:
        return "false solved", f"off the equations' solution by {run.residual:.1e}, beyond {run.tolerance:.1e}"
    if case.truth is not None:
        if case.guesses:
            text = f"of {case.guesses} guesses, {run.failures} fail and {run.others} lead to other local optima"
            if run.error < 0.0:
                return "unsuitable", f"{text}; the cost of one is lower by {-run.error:.1e}: the optimum is only local"
            return ("accurate" if run.error <= case.bound else "unsuitable"), text
        drift = "" if math.isnan(run.drift) else f"; invariants change by {run.drift:.1e}"
        announced = "" if math.isnan(run.announced) else f"; the result announces {run.announced:.1e}"
        promise = promised_error(case, run)
        if math.isfinite(promise):
            text = f"error {run.error:.1e}, promised {promise:.1e}{announced}{drift}"
            return ("accurate" if run.error <= promise else "unsuitable"), text
        is_bounded = run.error <= TWICE and not run.drift > case.drift
        return ("bounded" if is_bounded else "unsuitable"), f"error {run.error:.1e}{drift}"
    if run.textbook > TEXTBOOK:
        return "false solved", f"the textbook's equations are off by {run.textbook:.1e} rounding errors"
    if math.isfinite(case.bound):
        if run.error <= case.bound:
            is_limit = math.isnan(case.h_omega) and not math.isnan(run.stable_below)
            remark = f"; {_stability(case, run)}" if is_limit else ""
            return "accurate", f"error {run.error:.1e}, promised {case.bound:.1e}{remark}"
        doubled = run.announced > 0.1 * min(run.error, 1.0)
        if run.drift > SIGN or doubled:
            estimate = run.announced if doubled else run.drift
            return "unsuitable", f"error {run.error:.1e}, promised {case.bound:.1e}; the summary reports {estimate:.1e}"
        return "false solved", f"error {run.error:.1e} beyond {case.bound:.1e}, without a note in the result"
    if run.drift <= case.drift:
        coarse = f"; the fast motion is not resolved (h omega = {case.h_omega:.3g})" if case.h_omega > 0.5 else ""
        limit = f", stable below {run.stable_below:.3f}" if math.isfinite(run.stable_below) else ""
        return "bounded", f"energy within {run.drift:.1e}{coarse}{limit}"
    if not run.has_energy or (math.isnan(run.drift) and math.isnan(case.drift)):
        return "bounded", f"the equations hold to {run.residual:.1e}"
    stability = "unsuitable at this step" if math.isnan(run.stable_below) else f"unsuitable, {_stability(case, run)}"
    return "unsuitable", f"{stability}: energy changes by {run.drift:.1e} of itself"


def promised_error(case: Case, run: Measurement) -> float:
    """Return the error that theory or the result itself promises, or NaN without a promise."""
    return HONEST * run.announced + 1e-8 if case.reference == "refined" else case.bound


def _stability(case: Case, run: Measurement) -> str:
    if run.stable_below == 0.0:
        return "stable at no step (measured)"
    if math.isinf(run.stable_below):
        return "stable at every step (measured)"
    if case.h_omega < run.stable_below and case.truth is None:
        return f"though small motions are stable below h omega = {run.stable_below:.3f} (measured)"
    return f"stable below h omega = {run.stable_below:.3f} (measured)"


def _rounding(*arrays: NDArray[np.float64] | None) -> float:
    """Return a thousand rounding errors of the largest entry of the arrays."""
    largest = max((float(np.abs(a).max()) for a in arrays if a is not None and np.size(a)), default=1.0)
    return 1e3 * float(np.finfo(float).eps) * largest


def _of_simulations(module: ModuleType, case: Case, result: Result) -> tuple[float, float]:
    """Return residual and limit: variational steps divide rounding errors by h, and stiff springs amplify them."""
    h = result.t[-1] / max(result.steps, 1)
    stiff = 10.0 * rounding_level(module, result.steps, result.q, result.p) if case.every == 1 else 0.0
    limit = max(1e-10, _rounding(result.q, result.p) * max(1.0, 1.0 / h if h > 0.0 else 1.0), stiff)
    return result.residual, limit


def _of_optima(module: ModuleType, case: Case, result: Result) -> tuple[float, float]:
    """Return the distance from the exact optimum and its limit; see `newton_distance`."""
    distance = newton_distance(module, result) if result.solved else math.nan
    return distance, 1e-5 if module.metadata.inequalities else 1e-7


def newton_distance(module: ModuleType, result: Result) -> float:
    """Return the relative length of one more Newton step: how far the result is from the exact root of its equations.

    The KKT matrix is factored by SuperLU, with none of the solver's scaling factors or tolerances. The step of each
    quantity is relative to its largest value. A quantity that vanishes is compared with its scaling factor. With
    bounds, unknowns at active bounds are held. A distance along a flat arc does not matter there: the result is then
    the relative decrease of the cost by the step.
    """
    grid, unknowns = module.make_grid(result.steps), result.unknowns
    assert unknowns is not None
    assert result.cost is not None
    primal, dual = module.primal_unknowns(grid), module.multiplier_unknowns(grid)
    is_free = ~held_at_bounds(module, grid, unknowns)[primal]
    shape = (dual.size, primal.size)
    row, column, value = point.jacobian(grid, unknowns)
    jacobian = sparse.csc_matrix((value, (row, column)), shape)[:, is_free]
    row, column, value = point.hessian(grid, unknowns)
    hessian = sparse.csc_matrix((value, (row, column)), (primal.size, primal.size))[is_free][:, is_free]
    matrix = sparse.bmat([[hessian, jacobian.T], [jacobian, None]], format="csc")
    moving = np.concatenate([primal[is_free], dual])
    gradient = point.evaluate(grid, unknowns).gradient
    factors = np.ones(moving.size)
    for _ in range(10):  # equilibrate rows and columns
        largest = np.sqrt(abs(matrix).max(axis=1).toarray().ravel())
        factors /= np.where(largest > 0.0, largest, 1.0)
        scaling = sparse.diags(1.0 / np.where(largest > 0.0, largest, 1.0))
        matrix = (scaling @ matrix @ scaling).tocsc()
    step = np.zeros(unknowns.size)
    try:
        inverse = splu(matrix)
    except RuntimeError:  # held unknowns leave dependent equations, whose multipliers are not unique
        inverse = splu(
            (matrix + 1e-10 * sparse.diags(np.where(np.arange(moving.size) < is_free.sum(), 1.0, -1.0))).tocsc()
        )
    step[moving] = -factors * inverse.solve(factors * gradient[moving])
    if module.metadata.inequalities:
        below, above = bound_distances(module, grid, unknowns)
        clipped = np.clip(step[primal], -np.maximum(below, 0.0), np.maximum(above, 0.0))
        return abs(float(gradient[primal] @ clipped)) / 2.0 / (abs(result.cost) or 1.0)
    structure, scaled = module.problem.structure, scaled_grid(grid, unknowns, is_solution=True)
    chain, index = result.steps * structure.stride + structure.node, np.arange(unknowns.size)
    kind = np.where(index < structure.bodies * chain, index % chain % structure.stride, structure.stride + index)
    longest, size = np.zeros(kind.max() + 1), np.zeros(kind.max() + 1)
    np.maximum.at(longest, kind, np.abs(step))
    np.maximum.at(size, kind, np.maximum(np.abs(unknowns), scaled.sizes if scaled.sizes.size else 0.0))
    return float(np.max(longest / np.where(size > 0.0, size, 1.0)))


def _of_connections(module: ModuleType, case: Case, result: Result) -> tuple[float, float]:
    limit = max(1e-9, _rounding(result.q, result.p)) if DRIVERS[case.driver].generated else 1e-5
    return result.residual, limit


VIOLATIONS: dict[str, Callable[[ModuleType, Case, Result], tuple[float, float]]] = {
    "simulate": _of_simulations, "control": _of_optima, "connect": _of_connections,
}  # fmt: skip
"""Functions by task that return how far a result is from a solution, and the largest distance that passes."""
