"""Accuracy of fitted parameters: standard errors, correlations, confidence intervals.

The cost is the sum of the squared errors divided by their variances. The covariance of the estimates is twice the
inverse of its reduced Hessian. The reduced Hessian is the Schur complement of the KKT matrix at the solution for the
free parameters: states, controls and multipliers are eliminated. If no standard deviations are given, a common standard
deviation is estimated from the residuals of the fit. For robust losses the sandwich formula of M-estimators gives the
covariance. Gauss-Newton errors, as in `nls` of R and `curve_fit` of scipy, neglect the second derivatives of the
motion. Sources: Bard (1974), Nonlinear parameter estimation, chapter 7; Seber and Wild (1989), Nonlinear regression,
sections 2.1 and 5.1; Huber (1967), The behavior of maximum likelihood estimates under nonstandard conditions.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from codegen.solving.loading import ControlModule, Grid, Matrix, Vector

CONFIDENCE = 0.95
"""Confidence level of the intervals of parameters."""
AT_BOUND = 1e-6
"""Largest distance to an active bound, relative to the value of the unknown or to 1, whichever is larger."""
FLAT = 1e-11
"""Curvature, relative to the largest curvature, below which a direction is undetermined.

Smaller curvatures are rounding errors of the KKT matrix.
"""
WITHOUT_EFFECT = 1e-10
"""Effect of a parameter on the cost, relative to the largest effect, below which the parameter is undetermined.

The effect of a parameter is its curvature times the square of its value.
"""
NO_SIZE = 1e-9
"""Parameter value below which 1 is used as the scale of the parameter.

The value is relative to the largest parameter, or to 1 if all parameters are smaller.
"""
_Sample: TypeAlias = tuple[int, int, int, Vector, Vector]
"""The body, the interval, the column of the first parameter, the row of parameters and the times of nodes."""
_PART = 1e-3
"""Component of an undetermined direction above which a parameter is undetermined."""


class Fit:
    """The measurements of all bodies, and the values of the motion at the times of the measurements.

    A sample is all quantities that were measured at one time for one body. Samples are sorted by body. `bodies` and
    `times` have the shape (samples,). `measured`, `fitted` and `weights` (reciprocal standard deviations) have the
    shape (samples, columns). A missing value has the weight zero.
    """

    def __init__(self, module: ControlModule, grid: Grid, unknowns: Vector) -> None:
        """Read the samples from the parameters of the grid, and evaluate the motion at their times."""
        self._module, self._unknowns = module, unknowns
        self._structure = s = module.problem.structure
        self._chain = grid.steps * s.stride + s.node
        nodes = grid.nodes * grid.h
        # The parameters of each body, with the linking variables of the solution.
        rows = np.array(grid.parameters)
        first = s.first_sample - s.tabled - s.shared
        rows[:, first : first + s.shared] = unknowns[self._linking(unknowns.size)]
        self._samples = [
            (body, int(np.searchsorted(nodes, row[begin])) - 1, begin, row, nodes)
            for body, row in enumerate(rows)
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
        self.fitted = np.empty((len(self._samples), columns))
        for values, sample in zip(self.fitted, self._samples, strict=True):
            plain(module.sample_values)(*self._arguments(sample), values)

    def _linking(self, size: int) -> NDArray[np.intp]:
        """Return the indices (bodies, shared) of the linking variables among `size` unknowns."""
        return np.asarray(size - self._structure.root + self._structure.root_indices())

    def _arguments(self, sample: _Sample) -> tuple[Vector, float, float, Vector, int]:
        """Return the arguments of the compiled functions `sample_values` and `sample_gradient` for a sample."""
        body, k, begin, row, nodes = sample
        first = body * self._chain + k * self._structure.stride
        local = self._unknowns[first : first + self._structure.element]
        return local, nodes[k], nodes[k + 1] - nodes[k], row, begin

    @property
    def errors(self) -> Matrix:
        """Motion minus measurement, divided by the standard deviation (samples, columns); NaN for missing values."""
        return np.where(self.weights > 0.0, (self.fitted - self.measured) * self.weights, np.nan)

    @property
    def count(self) -> int:
        """Number of measured values."""
        return int((self.weights > 0.0).sum())

    @property
    def squares(self) -> float:
        """Sum of the squares of all errors."""
        return float(np.nansum(self.errors**2))

    def slopes(self, following: Matrix) -> Matrix:
        """Return the derivatives (samples, p) of the loss of each sample with respect to p quantities.

        `following` (n, p) has the derivatives of all n unknowns with respect to these quantities.
        """
        return np.array([self._slope(sample, following) for sample in self._samples])

    def error_slopes(self, following: Matrix) -> Matrix:
        """Return the derivatives (count, p) of all weighted errors w e with respect to p quantities.

        `following` (n, p) has the derivatives of all n unknowns with respect to these quantities. The loss must be
        "squares". The module has code only for derivatives of the loss of a sample. The loss (w e)^2 of one error
        e = 1/(2 w) has the derivative w de. Each measured value is therefore replaced such that its error is 1/(2 w),
        and the sample omits all other values.
        """
        slopes, columns = [], self.fitted.shape[1]
        for sample, fitted, weights in zip(self._samples, self.fitted, self.weights, strict=True):
            body, k, begin, row, nodes = sample
            for column in np.flatnonzero(weights > 0.0):
                single = row.copy()
                single[begin + 2 + columns : begin + 2 + 2 * columns] = 0.0
                single[begin + 2 + columns + column] = weights[column]
                single[begin + 2 + column] = fitted[column] - 0.5 / weights[column]
                slopes.append(self._slope((body, k, begin, single, nodes), following))
        return np.array(slopes).reshape(self.count, following.shape[1])

    def _slope(self, sample: _Sample, following: Matrix) -> Vector:
        """Return the derivatives (p,) of the loss of one sample; see `slopes` for `following`."""
        s = self._structure
        local = np.zeros(s.element + s.shared)
        plain(self._module.sample_gradient)(*self._arguments(sample), local)
        first = sample[0] * self._chain + sample[1] * s.stride
        linking = self._linking(len(following))[sample[0]]
        return np.asarray(
            local[: s.element] @ following[first : first + s.element] + local[s.element :] @ following[linking]
        )


def plain(function: Any) -> Any:
    """Return the Python function behind a function of numba, so that a call compiles nothing."""
    return getattr(function, "py_func", function)


@dataclass(frozen=True)
class Estimates:
    """The optimal values of p free parameters with their accuracy.

    Attributes
    ----------
    names : tuple of str
        Names of the free parameters, in the order of all arrays.
    values, standard_errors : ndarray, shape (p,)
        Standard errors are computed from the reduced Hessian. The error is NaN for a parameter in `at_bounds` or
        `undetermined`.
    gauss_newton_errors : ndarray, shape (p,)
        Standard errors from the first derivatives of the errors, as R and scipy compute them. They are NaN for robust
        losses.
    intervals : ndarray, shape (p, 2)
        Confidence intervals, which extend `quantile` standard errors to both sides of the value.
    correlations : ndarray, shape (p, p)
    deviation : float
        Standard deviation of the measurement errors, estimated with `freedom` degrees of freedom. It is 1 if standard
        deviations are given, because errors are then divided by them.
    is_estimated : bool
        True if `deviation` is estimated.
    freedom : int
        Number of measured values minus the number of estimated quantities.
    quantile : float
        Quantile of Student's t distribution if `deviation` is estimated, otherwise of the normal distribution.
    unknown_errors : ndarray, shape (n,)
        Standard errors of all unknowns; NaN if quantities other than the parameters are free.
    at_bounds, undetermined : tuple of str
        Parameters at a bound; parameters that can change without a change of the cost.
    reason : str
        Reason for missing standard errors; empty if they exist.
    """

    names: tuple[str, ...]
    values: Vector
    standard_errors: Vector
    gauss_newton_errors: Vector
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
        """Notes for the user, one line each."""
        notes = [f"no standard errors: {self.reason}"] if self.reason else []
        if self.undetermined:
            verb, whose = ("is", "it") if len(self.undetermined) == 1 else ("are", "some of them")
            value = "a value" if len(self.undetermined) == 1 else "values"
            notes.append(
                f"{', '.join(self.undetermined)} {verb} not determined by the measurements: other values fit as well; "
                f"give {whose} {value}, or measure more"
            )
        if self.at_bounds:
            notes.append(f"{', '.join(self.at_bounds)}: held at a bound, without a standard error")
        return notes


def estimates_of(module: ControlModule, grid: Grid, unknowns: Vector, held: NDArray[np.bool_]) -> Estimates | None:
    """Return the free parameters of a solution with their accuracy; None without measurements or free parameters.

    `held` (n,) is a mask of the `unknowns` (n,) that are at a bound.
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
    covariance, unknown_errors = np.full((len(names), len(names)), np.nan), np.full(unknowns.size, np.nan)
    gauss_newton = np.full(len(names), np.nan)
    if reduced and inverse and not reason:
        if observations.loss == "squares":
            block = 2.0 * float(deviation) ** 2 * inverse.matrix
            slopes = fit.error_slopes(reduced.following)
            factor = np.linalg.pinv(slopes, rcond=np.sqrt(FLAT))
            gauss_newton[is_free] = float(deviation) * np.sqrt((factor**2).sum(axis=1))
            gauss_newton[lost] = np.nan
        else:
            slopes = fit.slopes(reduced.following)
            block = inverse.matrix @ (slopes.T @ slopes) @ inverse.matrix
        if reduced.freedom == len(block):  # only the parameters are free
            variances = np.einsum("ni,ij,nj->n", reduced.following, block, reduced.following)
            unknown_errors = np.asarray(np.sqrt(np.maximum(0.0, variances)))
        covariance[np.ix_(is_free, is_free)] = block
        covariance[lost] = covariance[:, lost] = np.nan
    from scipy import stats

    tail = 0.5 + CONFIDENCE / 2.0
    quantile = float(stats.t.ppf(tail, freedom) if is_estimated and freedom > 0 else stats.norm.ppf(tail))
    errors = np.sqrt(np.diag(covariance))
    intervals = np.column_stack([values - quantile * errors, values + quantile * errors])
    with np.errstate(invalid="ignore"):  # the errors of an exact fit are zero
        correlations = covariance / np.outer(errors, errors)
    at_bounds, undetermined = (
        tuple(name for name, is_one in zip(names, mask, strict=True) if is_one) for mask in (~is_free, lost)
    )
    return Estimates(
        names, values, errors, gauss_newton, intervals, correlations, float(deviation), is_estimated, freedom, quantile,
        unknown_errors, at_bounds, undetermined, reason,
    )  # fmt: skip


@dataclass(frozen=True)
class _Reduced:
    """The reduced Hessian (p, p) of the cost with respect to the free parameters.

    Each diagonal entry is a sum, and `terms` (p,) has the sums of the moduli of its terms. `following` (n, p) has the
    derivatives of all unknowns with respect to the free parameters. `freedom` is the number of quantities that the
    measurements determine: primal unknowns that are not at a bound, minus equations.
    """

    hessian: NDArray[np.float64]
    terms: Vector
    following: NDArray[np.float64]
    freedom: int


def _reduced(
    module: ControlModule, grid: Grid, unknowns: Vector, held: NDArray[np.bool_], free: NDArray[np.intp]
) -> _Reduced | None:
    """Return the reduced Hessian of the cost with respect to the unknowns with the indices `free`.

    The optimality conditions determine all other unknowns, except the unknowns in the mask `held`, which stay fixed.
    Return None if the KKT matrix of the other unknowns is singular.
    """
    from scipy import sparse
    from scipy.sparse.linalg import splu

    from codegen.runtime.search import point  # which imports numba

    primal, dual = module.primal_unknowns(grid), module.multiplier_unknowns(grid)
    size, equations = primal.size, dual.size
    rows, columns, values = point.hessian(grid, unknowns)
    hessian = sparse.csc_matrix((values, (rows, columns)), shape=(size, size))
    rows, columns, values = point.jacobian(grid, unknowns)
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
    """The pseudoinverse (p, p) of a Hessian, which omits undetermined directions.

    `flat` is the number of undetermined directions. `lost` (p,) is a mask of the parameters that contribute to them.
    """

    matrix: NDArray[np.float64]
    lost: NDArray[np.bool_]
    flat: int


def _inverse(reduced: _Reduced, values: Vector) -> _Inverse:
    """Return the pseudoinverse of the reduced Hessian; `values` (p,) are the values of the free parameters.

    The Hessian is scaled such that every diagonal entry is 1, and its eigenvalues are compared with the largest one. A
    parameter without effect on the cost is undetermined. Its computed curvature is a rounding error, or a negligible
    error of the optimum. Effects of parameters are compared by their curvature times the square of their value.
    """
    hessian, diagonal = reduced.hessian, np.abs(np.diag(reduced.hessian))
    scales = np.where(np.abs(values) > NO_SIZE * np.abs(values).max(initial=1.0), np.abs(values), 1.0)
    effects = diagonal * scales**2
    ineffective = (diagonal <= FLAT * reduced.terms) | (effects <= WITHOUT_EFFECT * effects.max(initial=0.0))
    units = np.where(ineffective, 0.0, 1.0 / np.sqrt(np.where(ineffective, 1.0, diagonal)))
    curvatures, directions = np.linalg.eigh(hessian * np.outer(units, units))
    flat = curvatures <= FLAT * max(curvatures.max(initial=0.0), np.finfo(float).tiny)
    inverse = (directions[:, ~flat] / curvatures[~flat]) @ directions[:, ~flat].T * np.outer(units, units)
    part = np.abs(directions[:, flat]).max(axis=1, initial=0.0)
    return _Inverse(inverse, part > _PART, int(flat.sum()))


def as_record(estimates: Estimates) -> dict[str, object]:
    """Return the estimates as an object for JSON, in which NaN is None."""
    numbers = estimates.values, estimates.standard_errors, estimates.gauss_newton_errors, estimates.intervals
    return {
        "parameters": {
            name: {
                "value": as_finite(value),
                "standard_error": as_finite(error),
                "gauss_newton_error": as_finite(gauss_newton),
                "interval": [*map(as_finite, interval)],
            }
            for name, value, error, gauss_newton, interval in zip(estimates.names, *numbers, strict=True)
        },
        "confidence": CONFIDENCE,
        "correlations": [[as_finite(entry) for entry in row] for row in estimates.correlations],
        "deviation": as_finite(estimates.deviation),
        "deviation_is_estimated": estimates.is_estimated,
        "degrees_of_freedom": estimates.freedom,
        "at_bounds": list(estimates.at_bounds),
        "undetermined": list(estimates.undetermined),
    }


def as_finite(number: float | None) -> float | None:
    """Return the number as a float, or None for NaN, infinity and None."""
    return float(number) if number is not None and np.isfinite(number) else None
