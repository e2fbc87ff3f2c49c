"""The particle ansatz as a weak solution of the Euler-Poincare equations, by numbers (thesis, B.2).

m = sum_i p_i delta(x - q_i) solves m_t + v . grad m + (grad v)' m + m div v = 0 if for every test function psi the sum
over particles of d/dt (p_i psi(q_i)) equals what v does to them. psi enters by its values and slopes at the particles
only, which are those of random polynomials that vanish on the circle with their normal derivatives.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from codegen.interfaces import ConnectModule, Vector
from codegen.report.measure.accuracy import points_of
from codegen.report.settings import Settings
from codegen.report.store import Case, Store, Values

SECTION = "weak solution"


def cases(settings: Settings, store: Store) -> Iterator[Case]:
    """Random test functions on every set of landmarks along their motion."""
    del store
    for count in (*settings.counts, 40):
        yield Case(SECTION, f"nc {count}", lambda c=count: _defects(settings, c))  # type: ignore[misc]


def _defects(settings: Settings, count: int) -> Values:
    module, points = settings.module("explicit-euler"), points_of(settings, count)
    solution = module.solve(points.start, points.target, 10)
    generator, worst, size = np.random.default_rng(5), 0.0, 0.0
    for k in (0, 5, 10):
        for _ in range(5):
            coefficients = generator.normal(size=(4, 4))
            defect, rate = weak_defect(module, solution.q[k], solution.p[k], coefficients)
            worst, size = max(worst, defect), max(size, rate)
    return {"largest defect": worst, "largest rate": size, "test functions": 15}


def weak_defect(module: ConnectModule, q: Vector, p: Vector, coefficients: Vector) -> tuple[float, float]:
    """The largest component of the weak equation's left side, and of its first term alone.

    (v . grad m) psi becomes -p . (psi div v + v . grad psi) by parts; the slopes of v are central differences.
    """
    gradient, none = np.empty((2, *q.shape)), np.zeros((len(q), 0))
    module.hamiltonian_gradient(np.stack([q, p]), none, np.zeros(0), gradient)
    velocity, force = gradient[1], -gradient[0]
    step = 1e-5
    slopes = np.stack(
        [(_field(module, q, p, q + h) - _field(module, q, p, q - h)) / (2 * step) for h in step * np.eye(2)], axis=-1
    )
    psi, psi_slope = _test_function(q, coefficients)
    divergence = np.trace(slopes, axis1=1, axis2=2)
    along = (psi_slope * velocity).sum(axis=1)
    rate = force.T @ psi + p.T @ along
    advected = -p.T @ (psi * divergence + along)
    stretched = np.einsum("i,ilk,il->k", psi, slopes, p)
    compressed = p.T @ (psi * divergence)
    return float(np.abs(rate + advected + stretched + compressed).max()), float(np.abs(rate).max())


def _field(module: ConnectModule, q: Vector, p: Vector, x: Vector) -> Vector:
    """The field v at places x, shape (m, 2): the velocity of particles there without momentum."""
    places, count = np.concatenate([q, x]), len(q)
    matrix = np.empty((len(places),) * 2)
    module.momentum_matrix(np.stack([places, np.zeros_like(places)]), np.zeros((len(places), 0)), np.zeros(0), matrix)
    return matrix[count:, :count] @ p


def _test_function(q: Vector, coefficients: Vector) -> tuple[Vector, Vector]:
    """The function psi = (1 - |x|^2)^2 sum_ab c_ab x^a y^b and its gradient at places of shape (n, 2)."""
    x, y = q.T
    powers = np.arange(4)
    in_x, in_y = x[:, None] ** powers, y[:, None] ** powers
    by_x = powers * x[:, None] ** np.maximum(powers - 1, 0)
    by_y = powers * y[:, None] ** np.maximum(powers - 1, 0)
    sums = [np.einsum("ia,ab,ib->i", a, coefficients, b) for a, b in ((in_x, in_y), (by_x, in_y), (in_x, by_y))]
    well = 1.0 - x**2 - y**2
    gradient = [well**2 * s - 4.0 * well * place * sums[0] for s, place in zip(sums[1:], (x, y), strict=True)]
    return well**2 * sums[0], np.stack(gradient, axis=1)
