"""How exactly measurements determine free parameters: standard errors, correlations, confidence intervals.

The inverse of the reduced Hessian of the cost, a sum of squares over variances, is half the covariance of what was
estimated. States, controls and multipliers are eliminated from the KKT matrix at the solution, so that a Hessian of the
free parameters alone is left. Where standard deviations are not given, the one that all errors have in common is
estimated from what is left of them. Of robust losses the covariance is that of M-estimators. Sources: Bard (1974),
Nonlinear parameter estimation, chapter 7; Seber and Wild (1989), Nonlinear regression, sections 2.1 and 5.1; Huber
(1967), The behavior of maximum likelihood estimates under nonstandard conditions.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from codegen.solving.loading import Grid, Matrix, Vector


class Fit:
    """Measurements beside the motion of a solution, one after the other for each body."""

    def __init__(self, module: Any, grid: Grid, unknowns: Vector) -> None:
        """Read where samples lie out of the parameters of a grid, and what the motion is there."""
        self._module, self._unknowns = module, unknowns
        nodes = grid.nodes * grid.h
        self._structure = s = module.problem.structure
        self._chain = grid.steps * s.stride + s.node
        self._samples = [
            (body, int(np.searchsorted(nodes, row[begin])) - 1, begin, row, nodes)
            for body, row in enumerate(self._rows(grid))
            for begin in range(s.first_sample, row.size, s.sample)
            if np.isfinite(row[begin])
        ]
        columns = (s.sample - 2) // 2
        numbers = np.array([row[begin + 1 : begin + s.sample] for _, _, begin, row, _ in self._samples])
        self.bodies = np.array([body for body, *_ in self._samples])
        self.times = np.array([nodes[k] for _, k, *_ in self._samples])
        self.times += numbers[:, 0] * np.array([nodes[k + 1] - nodes[k] for _, k, *_ in self._samples])
        self.weights = numbers[:, 1 + columns :]
        self.measured = np.where(self.weights > 0.0, numbers[:, 1 : 1 + columns], np.nan)
        self.fitted = np.array([self._value(sample, columns) for sample in self._samples])

    def _rows(self, grid: Grid) -> Matrix:
        """The parameters of each body, with the shared unknowns of the solution."""
        rows, s, shared = np.array(grid.parameters), self._structure, self._linking(self._unknowns.size)
        first = s.first_sample - s.tabled - s.shared
        rows[:, first : first + s.shared] = self._unknowns[shared]
        return rows

    def _linking(self, size: int) -> Any:
        """The indices (bodies, shared), among `size` unknowns, of those that no node owns."""
        return size - self._structure.root + self._structure.root_indices()

    def _value(self, sample: Any, columns: int) -> Vector:
        _, values = self._given(sample), np.empty(columns)
        plain(self._module.sample_values)(*self._given(sample), values)
        return values

    def _given(self, sample: Any) -> tuple[Any, ...]:
        """What a kernel is called with for a sample."""
        body, k, begin, row, nodes = sample
        first = body * self._chain + k * self._structure.stride
        local = self._unknowns[first : first + self._structure.element]
        return local, nodes[k], nodes[k + 1] - nodes[k], row, begin

    @property
    def errors(self) -> Matrix:
        """The motion less what was measured, in parts of standard deviations; NaN where nothing was."""
        return np.where(self.weights > 0.0, (self.fitted - self.measured) * self.weights, np.nan)

    @property
    def count(self) -> int:
        """How many values were measured."""
        return int((self.weights > 0.0).sum())

    @property
    def squares(self) -> float:
        """The sum of squares of all errors."""
        return float(np.nansum(self.errors**2))

    def slopes(self, following: Matrix) -> Matrix:
        """How the loss of each sample follows p quantities, a row (p,) for each sample.

        `following` (n, p) says how all unknowns follow them.
        """
        module, s, shared = self._module, self._structure, self._linking(len(following))
        found = np.zeros((len(self._samples), following.shape[1]))
        for i, sample in enumerate(self._samples):
            local = np.zeros(s.element + s.shared)
            plain(module.sample_gradient)(*self._given(sample), local)
            first = sample[0] * self._chain + sample[1] * s.stride
            found[i] = local[: s.element] @ following[first : first + s.element]
            found[i] += local[s.element :] @ following[shared[sample[0]]]
        return found


def plain(function: Any) -> Any:
    """A function of a module as Python runs it, so that nothing has to be compiled."""
    return getattr(function, "py_func", function)


CONFIDENCE = 0.95
AT_BOUND = 1e-6
"""Parts of an unknown, or of one, by which it is away from a bound that holds it."""
FLAT = 1e-11
"""Parts of the largest curvature below which a direction counts as not determined: rounding of the KKT matrix."""
WITHOUT_EFFECT = 1e-10
"""Parts of the largest change of the cost, as parameters change by their values, that count as none."""
NO_SIZE = 1e-9
"""Parts of the largest parameter, or of one, below which the value of another one says nothing of its size."""


@dataclass(frozen=True)
class Estimates:
    """Free parameters with what measurements say of them; arrays have an entry for each of the p `names`.

    `intervals` are (p, 2), `correlations` (p, p). Parameters `at_bounds` are held there, and those that are
    `undetermined` could be others without changing the cost: neither have standard errors, which are NaN. `deviation`
    is the standard deviation of errors: one where their deviations are given, else estimated from `freedom`, the number
    of values less that of estimated numbers. `reason` says why there are no standard errors at all.

    `unknown_errors` (n,) are the standard errors of all unknowns as they follow the parameters, NaN where something
    else is free too; intervals extend `quantile` standard errors to both sides.
    """

    names: tuple[str, ...]
    values: Vector
    standard_errors: Vector
    intervals: Matrix
    correlations: Matrix
    deviation: float
    is_estimated: bool
    freedom: int
    quantile: float
    unknown_errors: Vector = field(repr=False)
    at_bounds: tuple[str, ...] = ()
    undetermined: tuple[str, ...] = ()
    reason: str = ""

    @property
    def notes(self) -> list[str]:
        """What a user should know, a line each."""
        found = [f"no standard errors: {self.reason}"] if self.reason else []
        if self.undetermined:
            verb = "is" if len(self.undetermined) == 1 else "are"
            found.append(
                f"{', '.join(self.undetermined)} {verb} not determined by the measurements: other values fit as well; "
                "give it a value, or measure more"
            )
        if self.at_bounds:
            found.append(f"{', '.join(self.at_bounds)}: held at a bound, without a standard error")
        return found


@dataclass(frozen=True)
class _Reduced:
    """The Hessian (p, p) of the cost by free parameters, and by how much all unknowns follow them, (n, p).

    `terms` (p,) are the sums of the moduli of what the diagonal is made of; `freedom` is how many numbers are free.
    """

    hessian: NDArray[np.float64]
    terms: Vector
    following: NDArray[np.float64]
    freedom: int


def estimates_of(module: Any, grid: Grid, unknowns: Vector, held: NDArray[np.bool_]) -> Estimates | None:
    """What measurements say of free parameters at a solution `unknowns` (n,), where there are any of both.

    `held` (n,) are unknowns at their bounds.
    """
    observations, names = module.metadata.observations, tuple(module.metadata.free_parameters)
    if not observations or not names:
        return None
    last = unknowns.size - module.problem.structure.couplings
    indices = np.arange(last - len(names), last)
    is_free, values = ~held[indices], unknowns[indices]
    fit, is_estimated = Fit(module, grid, unknowns), all(sigma is None for sigma in observations.sigmas)
    reduced = _reduced(module, grid, unknowns, held, indices[is_free])
    reason = "" if reduced else "the optimum is flat in something beside the parameters"
    inverse = _inverse(reduced, values[is_free]) if reduced else None
    lost, freedom = np.zeros(len(names), bool), fit.count
    if reduced and inverse:
        lost[is_free] = inverse.lost
        freedom -= reduced.freedom - inverse.flat
    if not reason and is_estimated and freedom <= 0:
        reason = f"{fit.count} values were measured, and {fit.count - freedom} numbers are free"
    deviation = np.sqrt(fit.squares / freedom) if is_estimated and freedom > 0 else np.nan if is_estimated else 1.0
    covariance, motion = np.full((len(names), len(names)), np.nan), np.full(unknowns.size, np.nan)
    if reduced and inverse and not reason:
        own = _covariance(reduced, inverse, fit, observations.loss, float(deviation))
        motion = _of_all(reduced, own)
        covariance[np.ix_(is_free, is_free)] = own
        covariance[lost] = covariance[:, lost] = np.nan
    errors, quantile = np.sqrt(np.diag(covariance)), _quantile(freedom if is_estimated else 0)
    intervals = np.column_stack([values - quantile * errors, values + quantile * errors])

    def named(which: NDArray[np.bool_]) -> tuple[str, ...]:
        return tuple(name for name, is_one in zip(names, which, strict=True) if is_one)

    with np.errstate(invalid="ignore"):  # where everything fits exactly
        correlations = covariance / np.outer(errors, errors)
    return Estimates(
        names, values, errors, intervals, correlations, float(deviation), is_estimated, freedom, quantile, motion,
        named(~is_free), named(lost), reason,
    )  # fmt: skip


def _covariance(reduced: _Reduced, inverse: _Inverse, fit: Fit, loss: str, deviation: float) -> NDArray[np.float64]:
    """The covariance (p, p) of free parameters."""
    if loss == "squares":
        return 2.0 * deviation**2 * inverse.matrix
    slopes = fit.slopes(reduced.following)
    return inverse.matrix @ (slopes.T @ slopes) @ inverse.matrix


def _of_all(reduced: _Reduced, covariance: NDArray[np.float64]) -> Vector:
    """The standard errors of all unknowns, (n,), where nothing is free but the parameters; else NaN."""
    if reduced.freedom != len(covariance):
        return np.full(len(reduced.following), np.nan)
    variances = np.einsum("ni,ij,nj->n", reduced.following, covariance, reduced.following)
    return np.asarray(np.sqrt(np.maximum(0.0, variances)))


def _quantile(freedom: int) -> float:
    """How many standard errors a confidence interval extends: Student's, or the normal distribution's for none."""
    from scipy import stats

    tail = 0.5 + CONFIDENCE / 2.0
    return float(stats.t.ppf(tail, freedom) if freedom > 0 else stats.norm.ppf(tail))


def _reduced(module: Any, grid: Grid, unknowns: Vector, held: NDArray[np.bool_], free: Any) -> _Reduced | None:
    """The Hessian of the cost by `free` unknowns when all others follow them; None where they do not."""
    from scipy import sparse
    from scipy.sparse.linalg import splu

    from codegen.runtime.search import callbacks  # which imports numba

    primal, dual = module.primal_unknowns(grid), module.multiplier_unknowns(grid)
    size, equations = primal.size, dual.size
    rows, columns, values = callbacks.hessian(grid, unknowns)
    hessian = sparse.csc_matrix((values, (rows, columns)), shape=(size, size))
    rows, columns, values = callbacks.jacobian(grid, unknowns)
    jacobian = sparse.csc_matrix((values, (rows, columns)), shape=(equations, size))
    whole = sparse.bmat([[hessian, jacobian.T], [jacobian, None]], format="csc")
    is_free = np.isin(primal, free)
    others = np.concatenate([np.flatnonzero(~is_free & ~held[primal]), size + np.arange(equations)])
    own = np.array([int(np.flatnonzero(primal == index)[0]) for index in free], dtype=int)
    coupling, block = whole[others][:, own].toarray(), whole[own][:, own].toarray()
    try:
        solved = -splu(whole[others][:, others].tocsc()).solve(coupling) if own.size else coupling
    except RuntimeError:  # singular
        return None
    following = np.zeros((unknowns.size, own.size))
    following[np.concatenate([primal, dual])[others]] = solved
    following[free] = np.eye(own.size)
    reduced = block + coupling.T @ solved
    if not np.isfinite(reduced).all():
        return None
    terms = np.abs(np.diag(block)) + np.abs(coupling * solved).sum(axis=0)
    return _Reduced((reduced + reduced.T) / 2.0, terms, following, int((~held[primal]).sum()) - equations)


@dataclass(frozen=True)
class _Inverse:
    """The inverse of a Hessian on the directions in which it is curved.

    `flat` is the number of the others, `lost` (p,) says which parameters they are made of.
    """

    matrix: NDArray[np.float64]
    lost: NDArray[np.bool_]
    flat: int


def _inverse(reduced: _Reduced, values: Vector) -> _Inverse:
    """The inverse of a reduced Hessian by parameters of these `values` (p,).

    Directions are compared in units in which every parameter has curvature one. One without an effect has none: what
    is left of its curvature is rounding, or, beside those of others by their values, what the optimum is off by.
    """
    hessian, diagonal = reduced.hessian, np.abs(np.diag(reduced.hessian))
    sizes = np.where(np.abs(values) > NO_SIZE * np.abs(values).max(initial=1.0), np.abs(values), 1.0)
    effects = diagonal * sizes**2
    idle = (diagonal <= FLAT * reduced.terms) | (effects <= WITHOUT_EFFECT * effects.max(initial=0.0))
    units = np.where(idle, 0.0, 1.0 / np.sqrt(np.where(idle, 1.0, diagonal)))
    curvatures, directions = np.linalg.eigh(hessian * np.outer(units, units))
    flat = curvatures <= FLAT * max(curvatures.max(initial=0.0), np.finfo(float).tiny)
    inverse = (directions[:, ~flat] / curvatures[~flat]) @ directions[:, ~flat].T * np.outer(units, units)
    part = np.abs(directions[:, flat]).max(axis=1, initial=0.0)
    return _Inverse(inverse, part > _PART, int(flat.sum()))


_PART = 1e-3
"""Of a direction, from which on a parameter takes part in it."""


def as_record(found: Estimates) -> dict[str, Any]:
    """The part of the JSON object about estimates."""
    rows = zip(found.names, found.values, found.standard_errors, found.intervals, strict=True)
    return {
        "parameters": {
            name: {"value": _finite(value), "standard_error": _finite(error), "interval": [*map(_finite, interval)]}
            for name, value, error, interval in rows
        },
        "confidence": CONFIDENCE,
        "correlations": [[_finite(entry) for entry in row] for row in found.correlations],
        "deviation": _finite(found.deviation),
        "deviation_is_estimated": found.is_estimated,
        "degrees_of_freedom": found.freedom,
        "at_bounds": list(found.at_bounds),
        "undetermined": list(found.undetermined),
    }


def _finite(number: Any) -> float | None:
    return float(number) if np.isfinite(number) else None
