"""Many particles that interact in pairs: two representative particles, and the terms of one and of two particles.

The Hamiltonian of n identical particles is H = sum_i self(z_i) + sum_{i<j} pair(z_i, z_j). The author declares two
particles, which stand for any two of them, and writes both terms. The number n is open until the problem is solved.
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
        """The Hamiltonian of particles contains coordinates and momenta only."""
        return "write the terms of a Hamiltonian without rates"


@dataclass(frozen=True)
class Particle:
    """One of two particles: coordinates `q`, momenta `p` and `own` parameters, such as a mass, as tuples."""

    q: tuple[ParticleQuantity, ...]
    p: tuple[ParticleQuantity, ...]
    own: tuple[ParticleQuantity, ...]
    other: Particle | None = field(default=None, repr=False, compare=False)


def particle(coordinates: str, momenta: str, own: str = "") -> Particle:
    """Declare one particle; `other` is any second one, for pair terms that are functions of both.

    Parameters
    ----------
    coordinates, momenta, own : str
        Names separated by blanks; `own` are parameters of each particle.

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
    """Declare any two particles by the names of their coordinates, momenta and own parameters.

    Parameters
    ----------
    coordinates, momenta, own : str
        Names separated by blanks, as many coordinates as space has dimensions.

    Returns
    -------
    tuple of two Particle
        For example `i, j = particles("x y", "px py")`.

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
    pair_term : expression or function
        Symmetric in both particles. With a single particle a function of that particle and another one.
    self_term : expression
        In quantities of the first particle. By default half the limit of `pair_term` at coincidence, as for a kernel
        that acts on itself.
    domain : sequence of expressions
        In the coordinates of the first particle; each is positive wherever a particle may be.
    """

    particles: tuple[Particle, Particle] | Particle
    _: KW_ONLY
    pair_term: Expression
    self_term: Expression = None
    domain: Sequence[Expression] = ()

    @property
    def pair(self) -> tuple[Particle, Particle]:
        """Any two particles; ExpressionError for a single particle without another."""
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
    duration : expression
    steps : int
    points : path
        File of points. It is read when the problem is solved, so that one module serves all files.
    path : function
        Of a start and a target, tuples of symbols, and of the fraction of the way between them. It returns the
        coordinates of a guessed position. By default the guess is a straight line.
    passive : bool
        If True, the module also carries points without momenta along with the motion.
    parallel : bool
        If True, several threads share the gradient of H for more particles than one block holds. The result is the same
        to the last digit.
    """

    task: ClassVar[str] = "connect"

    _: KW_ONLY
    duration: Expression = 1
    steps: int = 10
    points: Points
    path: Callable[..., Sequence[Expression]] | None = None
    passive: bool = False
    parallel: bool = False
