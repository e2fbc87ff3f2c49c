"""The motion with which simulations are compared, and quantities that it conserves."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from codegen.interfaces import SimulateModule, Vector

TIGHT, LOOSE = 3e-14, 1e-13
"""Relative tolerances of the reference, and of the run that tells how far it can be trusted."""
_STATES = 3


@dataclass(frozen=True)
class Motion:
    """States (q, p) at M + 1 times, shape (M + 1, 2n); how far two tolerances differ, by component's size."""

    times: Vector
    states: Any
    error: float
    energy_scale: float
    how: str


def field_of(module: SimulateModule, duration: float) -> Callable[[float, Vector], Vector]:
    """The vector field of a problem, read off a step of its explicit Euler method: (z_1 - z_0)/h, for a long h.

    The step is linear in h, so that a long one loses no digits to the subtraction.
    """
    h = 2.0 ** math.ceil(math.log2(duration))
    grid: Any = module.make_grid(1, duration=h)
    return lambda t, z: np.asarray((module.step(grid, z, t) - z) / h)


def reference_motion(module: SimulateModule, checkpoints: int, duration: float | None = None) -> Motion:
    """DOP853 through the field of an explicit Euler module, restarted at every checkpoint.

    Without a `duration`, over the problem's own.
    """
    duration = duration_of(module) if duration is None else duration
    field, start, times = field_of(module, duration), start_of(module), np.linspace(0.0, duration, checkpoints + 1)
    runs = []
    for tolerance in (LOOSE, TIGHT):
        states = [start]
        size = float(np.abs(start).max()) or 1.0
        for first, last in pairwise(times):
            done = solve_ivp(field, (first, last), states[-1], "DOP853", rtol=tolerance, atol=tolerance * size * 1e-3)
            states.append(done.y[:, -1])
        runs.append(np.array(states))
    error = float((np.abs(runs[1] - runs[0]) / component_sizes(runs[1])).max())
    how = f"DOP853 at relative tolerance {TIGHT:g} through the explicit Euler module's own field"
    return Motion(times, runs[1], error, _energy_scale(field, times, runs[1]), how)


def _energy_scale(field: Callable[[float, Vector], Vector], times: Vector, states: Any) -> float:
    """The largest sum of |p_i dq_i/dt|, twice the kinetic energy where there is one, to compare errors of H with."""
    half = states.shape[1] // 2
    works = [np.abs(z[half:] * field(t, z)[:half]).sum() for t, z in zip(times, states, strict=True)]
    return float(max(works)) or 1.0


def component_sizes(states: Any) -> Vector:
    """The largest place for every place, and the largest momentum for every momentum; shape (2n,)."""
    size = np.abs(states).max(axis=0)
    half = size.size // 2
    return np.concatenate([np.full(half, part.max() or 1.0) for part in (size[:half], size[half:])])


def duration_of(module: SimulateModule) -> float:
    """The problem's own duration."""
    grid = module.make_grid(1)
    return float(grid.h * grid.steps)


def start_of(module: SimulateModule) -> Vector:
    """The initial state (q, p), flat."""
    return np.asarray(module.make_grid(1).start, dtype=float).ravel()


def conserved(module: SimulateModule) -> dict[str, Callable[[Any], Any]]:
    """Momenta that Noether's theorem conserves, by name, as functions of states of shape (..., 2n).

    A momentum whose rate is exactly zero at several states belongs to a cyclic coordinate (and no force acts on it).
    For particles in Cartesian axes the total momentum along an axis and angular momenta are tried in the same way,
    up to rounding.
    """
    field, start = field_of(module, duration_of(module)), start_of(module)
    generator, half = np.random.default_rng(0), start.size // 2
    size = np.where(start == 0.0, 0.1 * float(np.abs(start).max() or 1.0), np.abs(start))
    states = [start + 0.2 * size * generator.uniform(-1.0, 1.0, start.size) for _ in range(_STATES)]
    rates = [field(0.0, z) for z in states]
    found: dict[str, Callable[[Any], Any]] = {}
    if not hasattr(module, "DIMENSION"):
        for i, name in enumerate(module.metadata.momenta or module.metadata.rates):
            if all(rate[half + i] == 0.0 for rate in rates):
                found[f"momentum {name}"] = partial(_momenta, first=half + i, axes=2 * half)
        return found
    axes = int(module.DIMENSION)
    for a in range(axes):
        if all(_vanishes(rate[half + a :: axes]) for rate in rates):
            found[f"total momentum along axis {a + 1}"] = partial(_momenta, first=half + a, axes=axes)
    for a in range(axes):
        for b in range(a):
            if all(_vanishes(_turning_rate(z, rate, a, b, axes)) for z, rate in zip(states, rates, strict=True)):
                found[f"angular momentum in the plane {b + 1}, {a + 1}"] = partial(_turning, a=a, b=b, axes=axes)
    return found


def _vanishes(terms: Any) -> bool:
    return bool(abs(np.sum(terms)) <= 1e-10 * np.abs(terms).sum())


def _momenta(z: Any, first: int, axes: int) -> Any:
    return np.asarray(z)[..., first::axes].sum(-1)


def _turning(z: Any, a: int, b: int, axes: int) -> Any:
    z = np.asarray(z)
    half = z.shape[-1] // 2
    q, p = z[..., :half], z[..., half:]
    return (q[..., b::axes] * p[..., a::axes] - q[..., a::axes] * p[..., b::axes]).sum(-1)


def _turning_rate(z: Any, rate: Any, a: int, b: int, axes: int) -> Any:
    half = z.size // 2
    q, p, dq, dp = z[:half], z[half:], rate[:half], rate[half:]
    return np.concatenate(
        [dq[b::axes] * p[a::axes], q[b::axes] * dp[a::axes], -dq[a::axes] * p[b::axes], -q[a::axes] * dp[b::axes]]
    )
