"""The definition of a problem of particles that interact in pairs, filled in by its generated module."""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from codegen.runtime.kernels import Kernel, Value, problem_of
from codegen.runtime.particles.steps import Pairs
from codegen.runtime.particles.tracers import Tracers
from codegen.runtime.record import ParticleRecord


@dataclass(frozen=True, eq=False)
class PairProblem:
    """Particles that interact in pairs: kernels with loops over particles and pairs, the scheme of a step, and names.

    States z have shape (2, n, d): positions, then momenta. Kernels take a state, own parameters (n, k) of the particles
    and common parameters, and fill their last argument.

    Attributes
    ----------
    metadata : ParticleRecord
        Names of the quantities, and their meanings.
    dimension : int
        Number d of coordinates of a particle.
    blocks : int
        Rows of H_pp for each particle: 1 if H_pp acts on all coordinates alike, else d.
    quadratic : bool
        True if H is kinetic energy alone.
    hamiltonian : Value
        Returns H.
    gradient : Kernel or None
        Fills H_q and H_p (2, n, d).
    hessian : Kernel or None
        Fills the second derivatives (2 n d, 2 n d) of H.
    products : Kernel or None
        Fills the products (2 n d, m) of the second derivatives and directions (2 n d, m).
    momentum_matrix : Kernel or None
        Fills H_pp (blocks n, blocks n).
    slope, velocity : Kernel or None
        Fill H_q (n, d) and H_p (n, d) separately, for schemes that update positions and momenta of a separable H in
        turn.
    domain_margin : Value or None
        Returns the least value, over all particles, of the functions that must be positive.
    guide : Kernel or None
        Fills the positions (n, d) after a fraction of the guessed way from start to target.
    tracer_velocity, tracer_gradient : Kernel or None
        Fill the velocities of tracer points, and velocities with their derivatives. They take `block` points at once.
    substeps : tuple
        Rows (f, a, b) of a composition method: fraction of the step, and weights of the end of the substep in the
        position and in the momentum at which H is evaluated.
    rows, weights : tuple
        Coefficients a_ij and b_i of an explicit Runge-Kutta method; used if there are no substeps.
    cost_weights : tuple
        Weights of the points of a step in the discrete cost.
    abscissa : float
        Abscissa on an interval at which the discrete action evaluates H.
    block : int
        Number of tracer points that are computed at once.
    coefficients : array
        Coefficients of the scheme: substeps (s, 3), or rows and weights (s + 1, s).
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
        """Pickle the problem as the name of its module; another process imports the module."""
        return problem_of, (self.hamiltonian.__module__,)

    @property
    def points(self):
        """The number of points of a step at which the scheme evaluates H."""
        return len(self.substeps or self.weights)

    @property
    def is_implicit(self):
        """True if the scheme solves equations in a step."""
        return self.gradient is not None and any(a != 0.0 or b != 0.0 for _, a, b in self.substeps)

    @cached_property
    def pairs(self):
        """The Pairs of the problem: addresses and numbers for compiled code."""
        return Pairs(
            self.hamiltonian.address, address_of(self.gradient), address_of(self.hessian if self.is_implicit else None),
            0, address_of(self.slope), address_of(self.velocity), address_of(self.domain_margin), self.points,
            int(not self.substeps), self.coefficients.ctypes.data,
        )  # fmt: skip

    @cached_property
    def pairs_with_products(self):
        """The Pairs with the address of `products`, for use without stored second derivatives."""
        return self.pairs._replace(products=self.products.address)

    @cached_property
    def costs(self):
        """The weights (points,) of the points of a step in the discrete cost."""
        return np.array(self.cost_weights, dtype=float)

    @cached_property
    def tracers(self):
        """The Tracers of the problem: addresses and numbers for compiled code."""
        return Tracers(
            self.tracer_velocity.address, self.tracer_gradient.address, self.dimension, self.block, self.points,
            int(not self.substeps), self.coefficients.ctypes.data,
        )  # fmt: skip

    def kernels(self):
        """Return the kernels that a solution calls, without `products`."""
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
    """Return the address of a kernel, or 0 if the kernel is None."""
    return 0 if kernel is None else kernel.address
