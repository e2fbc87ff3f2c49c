"""What an author writes about many particles that interact in pairs: two of them, and what one and two contribute.

The Hamiltonian of n identical particles is H = sum_i self(z_i) + sum_{i<j} pair(z_i, z_j). The author declares two
particles, which stand for any two of them, and writes both terms; n stays open until the problem is solved.
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
    """A coordinate, momentum or parameter of one of the two particles that stand for all."""

    __slots__ = ()

    @property
    def rate_remedy(self) -> str:
        """The Hamiltonian of particles holds coordinates and momenta alone."""
        return "write the terms of a Hamiltonian without rates"


@dataclass(frozen=True)
class Particle:
    """One of two particles: its place `q`, its momentum `p` and its `own` parameters, such as a mass, as tuples."""

    q: tuple[ParticleQuantity, ...]
    p: tuple[ParticleQuantity, ...]
    own: tuple[ParticleQuantity, ...]
    other: Particle | None = field(default=None, repr=False, compare=False)


def particle(coordinates: str, momenta: str, own: str = "") -> Particle:
    """Declare one particle; `other` is any second one, for pair terms that are functions of both.

    For example `i = particle("x y", "px py")` and `Pairwise(i, pair_term=lambda i, j: ...)`. Raises SymbolError as
    `particles` does.
    """
    first, second = particles(coordinates, momenta, own)
    return replace(first, other=second)


def particles(coordinates: str, momenta: str, own: str = "") -> tuple[Particle, Particle]:
    """Declare any two particles by the names of their coordinates, momenta and own parameters.

    For example `i, j = particles("x y", "px py")`; the names may be as many as space has dimensions. Raises
    SymbolError when a name is no identifier, occurs twice, or when coordinates and momenta differ in number.
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

    `pair_term` is symmetric in the two `particles`. `self_term` is an expression in quantities of the first of them;
    without one it is half the limit of `pair_term` at coincidence, as for a kernel that acts on itself. Each
    expression of `domain`, in the coordinates of the first particle, is positive wherever a particle may be.

    With a single `particle`, `pair_term` is a function of it and of another one.
    """

    particles: tuple[Particle, Particle] | Particle
    _: KW_ONLY
    pair_term: Expression
    self_term: Expression = None
    domain: Sequence[Expression] = ()

    @property
    def pair(self) -> tuple[Particle, Particle]:
        """Any two particles; ExpressionError for a single one without another."""
        if not isinstance(self.particles, Particle):
            return self.particles
        if self.particles.other is None:
            raise ExpressionError("Pairwise has one particle", 'declare it with particle("x", "p"), or give both')
        return self.particles, self.particles.other

    @property
    def term_of_pair(self) -> Expression:
        """The pair term as an expression in the quantities of both."""
        is_function = callable(self.pair_term) and not isinstance(self.pair_term, sympy.Basic)  # symbols can be called
        return self.pair_term(*self.pair) if is_function else self.pair_term


@refusing
@dataclass(frozen=True)
class Connect(Problem):
    """Find the motion of a pairwise Hamiltonian that carries given points to given points within `duration`.

    `points` is a file that holds them: it is read when the problem is solved, so that one module serves all files.
    `path` is a function of a start and a target, tuples of symbols, and of the fraction of the way between them; it
    returns the coordinates of a guessed position there, and may be left out for straight lines. With `passive=True`
    the module also carries points without momenta along with the motion. With `parallel=True` several threads share the
    gradient of H where there are more particles than one block holds; the result is the same to the last digit.
    """

    task: ClassVar[str] = "connect"

    _: KW_ONLY
    duration: Expression = 1
    steps: int = 10
    points: Points
    path: Callable[..., Sequence[Expression]] | None = None
    passive: bool = False
    parallel: bool = False
