"""What is to be connected, and whether it can be."""

from typing import Any, NamedTuple

import numpy as np

from codegen.runtime.search.grid import checked_count, checked_times, checked_tolerance


class Case(NamedTuple):
    """Points to connect: start and target (n, d), sigma (n,), own parameters (n, k), how, and the `PairProblem`."""

    start: np.ndarray
    target: np.ndarray
    sigma: np.ndarray
    own: np.ndarray
    parameters: np.ndarray
    steps: int
    duration: float
    tolerance: float
    max_iterations: int
    problem: Any


def checked_case(problem, start, target, sigma, own, parameters, steps, duration, tolerance, max_iterations):
    """Return a Case, whose fields give the shapes; ValueError names the points, or the argument, that are unusable."""
    start, target = np.array(start, dtype=float), np.array(target, dtype=float)
    if start.ndim != 2 or start.shape[1] != problem.dimension or start.shape[0] < 1:
        raise ValueError(f"start has shape {start.shape}, expected (n, {problem.dimension}) with at least one point")
    if target.shape != start.shape:
        raise ValueError(f"there are {len(start)} points at the start but {len(target)} at the target")
    count = len(start)
    sigma = np.array(np.broadcast_to(np.asarray(sigma, dtype=float), (count,)))
    if not np.isfinite(sigma).all() or (sigma < 0.0).any():
        raise ValueError("sigma must be finite and not negative")
    own = np.array([np.broadcast_to(np.asarray(values, dtype=float), (count,)) for values in own]).reshape(-1, count).T
    for name, column in zip(problem.metadata.own, own.T, strict=True):
        if not np.isfinite(column).all():
            raise ValueError(f"{name} must be finite, got {column}")
    for what, points in (("start", start), ("target", target)):
        require_possible(problem, what, points)
    parameters = np.array(parameters, dtype=float)
    if not np.isfinite(parameters).all():
        raise ValueError(f"parameters must be finite, got {parameters}")
    steps, duration = checked_times(steps, duration)
    own, max_iterations = np.ascontiguousarray(own), checked_count("max_iterations", max_iterations)
    tolerance = checked_tolerance(tolerance, 1e-6)
    return Case(start, target, sigma, own, parameters, steps, duration, tolerance, max_iterations, problem)


def require_possible(problem, what, points):
    """Refuse points, shape (n, d), that are not finite, outside their domain, or given twice."""
    if not np.isfinite(points).all():
        row = int(np.argmin(np.isfinite(points).all(axis=1)))
        raise ValueError(f"{what} of point {row + 1} is {points[row]}, expected finite numbers")
    if not problem.domain_margin(np.stack([points, np.zeros_like(points)])) > 0.0:
        margins = (problem.domain_margin(np.stack([points[k : k + 1]] * 2)) for k in range(len(points)))
        row = next(k for k, margin in enumerate(margins) if not margin > 0.0)
        position = ", ".join(f"{x:.6g}" for x in points[row])
        raise ValueError(f"{what} of point {row + 1}, ({position}), is on or outside the boundary of the domain")
    order = np.lexsort(points.T)
    same = np.flatnonzero((points[order[1:]] == points[order[:-1]]).all(axis=1))
    if same.size:
        first, second = sorted(order[same[0] : same[0] + 2] + 1)
        raise ValueError(f"{what} of points {first} and {second} is the same place; no map separates or joins them")
