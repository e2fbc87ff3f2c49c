"""The definition of a problem of particles that interact in pairs, as its generated module passes it."""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from codegen.runtime.kernels import Kernel, Value, problem_of
from codegen.runtime.particles.steps import Pairs
from codegen.runtime.particles.tracers import Tracers
from codegen.runtime.record import ParticleRecord


@dataclass(frozen=True, eq=False)
class PairProblem:
    """Particles that interact in pairs: loops over particles and pairs, the scheme of a step, names and numbers.

    States z have shape (2, n, d): positions, then momenta. Kernels take a state, own parameters (n, k) and common
    parameters, and fill their last argument.

    Attributes
    ----------
    metadata : Record
        Names and meanings.
    dimension, blocks : int
        Coordinates of a particle, d, and rows of H_pp for each particle: 1 if it acts on all components alike, else d.
    quadratic : bool
        True if H is kinetic energy alone.
    hamiltonian : Value
        H.
    gradient, hessian, products, momentum_matrix : Kernel or None
        H_q and H_p (2, n, d); second derivatives (2 n d, 2 n d), by momenta alone (blocks n, blocks n), and times
        directions (2 n d, m).
    slope, velocity : Kernel or None
        H_q and H_p (n, d) by themselves, of a separable H whose positions and momenta take turns.
    domain_margin : Value or None
        The least of the functions that must be positive at all particles.
    guide : Kernel or None
        Positions (n, d) after a part of the guessed way.
    tracer_velocity, tracer_gradient : Kernel or None
        Velocities of points without momenta, and their derivatives, a `block` of points at once.
    substeps : tuple
        Rows (fraction of the step, position and momentum between its ends) of a composition method; or
    rows, weights : tuple
        coefficients of an explicit Runge-Kutta method.
    cost_weights : tuple
        Weights of the points of a step in the discrete cost.
    abscissa : float
        Abscissa on an interval at which the discrete action evaluates H.
    """

    metadata: ParticleRecord
    dimension: int
    hamiltonian: Value
    blocks: int = 1
    quadratic: bool = False
    gradient: Kernel | None = None
    hessian: Kernel | None = None
    products: Kernel | None = None
    momentum_matrix: Kernel | None = None
    slope: Kernel | None = None
    velocity: Kernel | None = None
    domain_margin: Value | None = None
    guide: Kernel | None = None
    tracer_velocity: Kernel | None = None
    tracer_gradient: Kernel | None = None
    substeps: tuple[tuple[float, ...], ...] = ()
    rows: tuple[tuple[float, ...], ...] = ()
    weights: tuple[float, ...] = ()
    cost_weights: tuple[float, ...] = ()
    abscissa: float = 0.0
    block: int = 1
    coefficients: np.ndarray = field(init=False)

    def __post_init__(self):
        """Keep the coefficients of the scheme as one array: substeps (s, 3), or rows and weights (s + 1, s)."""
        table = self.substeps or (*self.rows, self.weights)
        object.__setattr__(self, "coefficients", np.array(table, dtype=float))

    def __reduce__(self):
        """Pickle the problem as the name of its module, which another process imports."""
        return problem_of, (self.hamiltonian.__module__,)

    @property
    def points(self):
        """The number of points of a step at which H is evaluated."""
        return len(self.substeps or self.weights)

    @property
    def is_implicit(self):
        """True if equations are solved inside a step."""
        return self.gradient is not None and any(a != 0.0 or b != 0.0 for _, a, b in self.substeps)

    @cached_property
    def pairs(self):
        """Addresses and numbers of the problem for compiled code."""
        return Pairs(
            self.hamiltonian.address, address_of(self.gradient), address_of(self.hessian if self.is_implicit else None),
            0, address_of(self.slope), address_of(self.velocity), address_of(self.domain_margin), self.points,
            int(not self.substeps), self.coefficients.ctypes.data,
        )  # fmt: skip

    @cached_property
    def pairs_with_products(self):
        """The same, with products of second derivatives and directions instead of stored derivatives."""
        return self.pairs._replace(products=self.products.address)

    @cached_property
    def costs(self):
        """The weights of the points of a step in the discrete cost, as an array."""
        return np.array(self.cost_weights, dtype=float)

    @cached_property
    def tracers(self):
        """Addresses and numbers of points without momenta for compiled code."""
        return Tracers(
            self.tracer_velocity.address, self.tracer_gradient.address, self.dimension, self.block, self.points,
            int(not self.substeps), self.coefficients.ctypes.data,
        )  # fmt: skip

    def kernels(self):
        """The kernels that a solution calls, without the products with second derivatives."""
        every = (
            self.gradient, self.hessian, self.momentum_matrix, self.slope, self.velocity, self.hamiltonian,
            self.domain_margin, self.guide, self.tracer_gradient, self.tracer_velocity,
        )  # fmt: skip
        return tuple(kernel for kernel in every if kernel is not None)

    def compile(self):
        """Compile all kernels of the problem."""
        for kernel in self.kernels():
            kernel.address  # noqa: B018


def address_of(kernel):
    """Return the address of a kernel, or 0 for None."""
    return 0 if kernel is None else kernel.address
