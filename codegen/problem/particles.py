"""Many particles that interact in pairs: the declaration of two representative particles, and of the Hamiltonian.

The Hamiltonian of n identical particles is H = sum_i self(z_i) + sum_{i<j} pair(z_i, z_j). The user declares two
particles, which represent any two of the n particles, and writes both terms. The number n is known only when the
problem is solved.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from typing import ClassVar

import sympy

from codegen.errors import ExpressionError, SymbolError
from codegen.problem.points import Points
from codegen.problem.problem import Expression, Problem, refusing
from codegen.problem.symbols import Quantity


class ParticleQuantity(Quantity):
    """A coordinate, momentum or parameter of one of the two representative particles."""

    __slots__ = ()

    @property
    def rate_remedy(self) -> str:
        """The remedy for a time derivative: the Hamiltonian of particles contains coordinates and momenta only."""
        return "write the terms of a Hamiltonian without rates"


@dataclass(frozen=True)
class Particle:
    """A representative particle: coordinates `q`, momenta `p` and `own` parameters, such as a mass.

    `other` is a second particle for functions of two particles; None if both were declared by `particles`.
    """

    q: tuple[ParticleQuantity, ...]
    p: tuple[ParticleQuantity, ...]
    own: tuple[ParticleQuantity, ...]
    other: Particle | None = field(default=None, repr=False, compare=False)


def particle(coordinates: str, momenta: str, own: str = "") -> Particle:
    """Declare one particle for pair terms that are written as functions of two particles.

    Parameters
    ----------
    coordinates, momenta, own : str
        Names separated by blanks; `own` are parameters that each particle has, such as a mass.

    Returns
    -------
    Particle
        For example `i = particle("x y", "px py")` and `Pairwise(i, pair_term=lambda i, j: ...)`.

    Raises
    ------
    SymbolError
        As for `particles`.
    """
    first, second = particles(coordinates, momenta, own)
    return replace(first, other=second)


def particles(coordinates: str, momenta: str, own: str = "") -> tuple[Particle, Particle]:
    """Declare two representative particles by the names of their coordinates, momenta and own parameters.

    Parameters
    ----------
    coordinates, momenta, own : str
        Names separated by blanks, with one coordinate for each dimension of space. `own` are parameters that each
        particle has, such as a mass.

    Returns
    -------
    tuple of two Particle
        For example `i, j = particles("x y", "px py")`. Their symbols have names such as `x_i` and `x_j`.

    Raises
    ------
    SymbolError
        If a name is no identifier or occurs twice, or coordinates and momenta differ in number.
    """
    qs, ps, parameters = ([*names.replace(",", " ").split()] for names in (coordinates, momenta, own))
    if not qs or len(qs) != len(ps):
        raise SymbolError(f"{len(qs)} coordinates but {len(ps)} momenta", "give one momentum for each coordinate")
    names = [*qs, *ps, *parameters]
    for name in names:
        if names.count(name) > 1:
            raise SymbolError(f"two quantities of a particle are called {name}", "give one of them another name")

    def one(mark: str) -> Particle:
        first, second, third = (tuple(ParticleQuantity(f"{n}_{mark}") for n in group) for group in (qs, ps, parameters))
        return Particle(first, second, third)

    return one("i"), one("j")


@dataclass(frozen=True)
class Pairwise:
    """The Hamiltonian H = sum_i self_term(z_i) + sum_{i<j} pair_term(z_i, z_j) of identical particles.

    Parameters
    ----------
    particles : Particle or tuple of two Particle
        The representative particles, from `particle` or `particles`.
    pair_term : expression or function
        Expression in the quantities of both particles, or function of two particles, which is symmetric in them.
    self_term : expression
        Expression in the quantities of the first particle. The default is half the limit of `pair_term` if both
        particles coincide, as for a kernel that acts on itself.
    domain : sequence of expressions
        Expressions in the coordinates of the first particle, which must be positive at all positions of particles.
    """

    particles: tuple[Particle, Particle] | Particle
    _: KW_ONLY
    pair_term: Expression
    self_term: Expression = None
    domain: Sequence[Expression] = ()

    @property
    def pair(self) -> tuple[Particle, Particle]:
        """The two representative particles; ExpressionError if only one particle was given."""
        if not isinstance(self.particles, Particle):
            return self.particles
        if self.particles.other is None:
            raise ExpressionError("Pairwise has one particle", 'declare it with particle("x", "p"), or give both')
        return self.particles, self.particles.other

    @property
    def term_of_pair(self) -> Expression:
        """The pair term as an expression in the quantities of both particles."""
        is_function = callable(self.pair_term) and not isinstance(self.pair_term, sympy.Basic)  # symbols are callable
        return self.pair_term(*self.pair) if is_function else self.pair_term


@refusing
@dataclass(frozen=True)
class Connect(Problem):
    """Find the motion of a pairwise Hamiltonian that carries given points to given targets within `duration`.

    Parameters
    ----------
    hamiltonian : Pairwise
        Hamiltonian of the particles.
    duration : expression
        Time of the motion.
    steps : int
        Default number of time steps.
    points : path
        File with the starts and targets of all particles. The file is read when the problem is solved, so that one
        module can be used with several files.
    path : function
        Function (start, target, fraction) that returns a guessed position of a particle. `start` and `target` are
        tuples of symbols, and `fraction` is the fraction of the way. By default the guess is a straight line.
    passive : bool
        If True, the module can also move points that have no momenta and follow the motion of the particles.
    parallel : bool
        If True, several threads compute the gradient of H if there are more particles than one block holds. The result
        is the same to the last digit.
    """

    task: ClassVar[str] = "connect"

    _: KW_ONLY
    duration: Expression = 1
    steps: int = 10
    points: Points
    path: Callable[..., Sequence[Expression]] | None = None
    passive: bool = False
    parallel: bool = False
