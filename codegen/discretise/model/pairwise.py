"""The canonical form of a problem about particles that interact in pairs: checked, in plain sympy symbols."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np
from sympy import Expr, Symbol

from codegen import identifiers
from codegen.discretise.model.normal_form import require_unique_names
from codegen.errors import BoundaryError, ExpressionError, ProblemFileError, SymbolError, is_count
from codegen.problem.particles import Connect, Pairwise, Particle, ParticleQuantity
from codegen.problem.problem import Problem, Simulate
from codegen.problem.symbols import Parameter, Quantity
from codegen.symbolic import checks as expressions
from codegen.symbolic.functions import tables_of
from codegen.symbolic.terms import Invariants

Table: TypeAlias = tuple[tuple[float, ...], ...]
"""Numbers of all particles: one row for each particle."""
FRACTION = Symbol("fraction", real=True)
"""The fraction of the way from start to target."""


@dataclass(frozen=True)
class ParticleSymbols:
    """The symbols of the coordinates `q`, momenta `p` and `own` parameters of one particle in a pair."""

    q: tuple[Symbol, ...]
    p: tuple[Symbol, ...]
    own: tuple[Symbol, ...]

    @property
    def moving(self) -> tuple[Symbol, ...]:
        """Return the coordinates, then the momenta."""
        return (*self.q, *self.p)


@dataclass(frozen=True)
class PairwiseModel:
    """A pairwise Hamiltonian in canonical form: H = sum_i self_term(z_i) + sum_{i<j} pair_term(z_i, z_j).

    `coordinates`, `momenta` and `own` are the names of the quantities of a particle. The symbols of the particles
    `first` and `second` of a pair append `_i` and `_j`. A particle may be where all expressions of `domain`, in
    coordinates of `first`, are positive. `limit` is the limit of the pair term for coinciding particles, or None.
    `smooth` is True if the gradient of the pair term tends to the gradient of the limit.

    A connect problem has `points`, the default file. Its `path` is the guessed position after a FRACTION of the way, in
    coordinates of `first` for the start and of `second` for the target. It is `passive` if it carries points without
    momenta, and `parallel` if several threads compute its gradient. A simulation of n particles in d dimensions with k
    own parameters has the arrays `start` of shape (2, n, d) and `own_values` of shape (n, k).
    """

    task: str
    name: str
    title: str
    coordinates: tuple[str, ...]
    momenta: tuple[str, ...]
    own: tuple[str, ...]
    first: ParticleSymbols
    second: ParticleSymbols
    parameters: tuple[Symbol, ...]
    defaults: tuple[float, ...]
    self_term: Expr
    pair_term: Expr
    domain: tuple[Expr, ...]
    limit: Expr | None
    smooth: bool
    duration: Expr
    steps: int
    points: str = ""
    path: tuple[Expr, ...] = ()
    passive: bool = False
    parallel: bool = False
    start: tuple[Table, ...] = ()
    own_values: Table = ()
    unused: tuple[str, ...] = ()
    drawing: tuple[()] = ()

    @property
    def connects(self) -> bool:
        """Return True if particles move to given targets, False in a simulation."""
        return self.task == "connect"


def is_pairwise(problem: object) -> bool:
    """Return True if an author's problem is about particles that interact in pairs."""
    return isinstance(problem, Connect) or isinstance(getattr(problem, "hamiltonian", None), Pairwise)


def normalise_pairwise(problem: Problem, declared: Sequence[Quantity], name: str, title: str) -> PairwiseModel:
    """Return the checked canonical form of an author's problem about particles.

    Raises a kind of CodegenError that names the symbol or expression and the remedy.
    """
    system = problem.hamiltonian
    if not isinstance(system, Pairwise):
        raise ProblemFileError("Connect needs a pairwise Hamiltonian", "write hamiltonian=Pairwise(...)")
    if not isinstance(problem, (Connect, Simulate)):
        raise ProblemFileError("a pairwise Hamiltonian in a control problem", "return Connect(...) or Simulate(...)")
    for argument in ("constraint", "rolling", "events", "unilateral"):
        if isinstance(problem, Simulate) and getattr(problem, argument):
            remedy = "leave it out, or write the Lagrangian of each particle"
            raise ExpressionError(f"{argument} beside particles", remedy)
    terms = {"pair_term": expressions.checked(system.term_of_pair, "pair_term")}
    if system.self_term is not None:
        terms["self_term"] = expressions.checked(system.self_term, "self_term")
    terms |= {f"domain[{k}]": expressions.checked(value, f"domain[{k}]") for k, value in enumerate(system.domain)}
    terms["duration"] = expressions.checked(problem.duration, "duration")
    for what, term in terms.items():
        if tables := tables_of(term):
            finding = f"{what} reads table {tables[0].shape.name}"
            raise ExpressionError(finding, "write a formula; particles have no tables")
    particle_symbols = {s for one in system.pair for s in (*one.q, *one.p, *one.own)}
    for what, expression in terms.items():
        for symbol in sorted(expression.free_symbols, key=str):
            if symbol not in particle_symbols and not isinstance(symbol, Parameter):
                raise SymbolError(
                    f"{symbol} in {what} is no parameter and belongs to no particle", "use particles(...)"
                )
    require_unique_names(declared)
    present = set().union(*(e.free_symbols for e in terms.values()))
    parameters = tuple(symbol for symbol in declared if isinstance(symbol, Parameter) and symbol in present)
    plain = _plain_symbols(system.pair, parameters, problem.task)
    first, second = (
        ParticleSymbols(*(tuple(plain[s] for s in g) for g in (one.q, one.p, one.own))) for one in system.pair
    )
    tidied = {what: expressions.tidied(term.xreplace(plain)) for what, term in terms.items()}
    pair, self_term = tidied["pair_term"], tidied.get("self_term")
    of_second = {*second.moving, *second.own}
    if self_term is not None and self_term.free_symbols & of_second:
        raise ExpressionError("self_term depends on the second particle", "write it in quantities of the first")
    one, other = (*first.moving, *first.own), (*second.moving, *second.own)
    swapped = pair.xreplace(dict(zip((*one, *other), (*other, *one), strict=True)))
    points = expressions.sample_points(pair.free_symbols | swapped.free_symbols, {}, {})
    for point in [next(points) for _ in range(4)]:
        values = [expressions.number_at(e, point) for e in (pair, swapped)]
        if None not in values and not np.isclose(values[0], values[1], rtol=1e-12):  # type: ignore[arg-type]
            raise ExpressionError("pair_term changes when the two particles are exchanged", "write a symmetric term")
    limit, smooth = Invariants.of(pair, first.moving, second.moving).coincidence()
    start, own_values = _particles_at_start(problem, system.pair[0]) if isinstance(problem, Simulate) else ((), ())
    if self_term is None:
        if limit is None:
            raise ExpressionError("self_term is missing", "pair_term has no limit at coincidence that could replace it")
        # Half of the interaction with another particle at the same point.
        of_first = zip((*second.own, *second.p), (*first.own, *first.p), strict=True)
        self_term = limit.xreplace(dict(of_first)) / 2
    if not is_count(problem.steps):
        raise ExpressionError(f"steps is {problem.steps!r}", "give a positive integer")
    return PairwiseModel(
        task=problem.task,
        name=name,
        title=title,
        coordinates=tuple(symbol.name.removesuffix("_i") for symbol in first.q),
        momenta=tuple(symbol.name.removesuffix("_i") for symbol in first.p),
        own=tuple(symbol.name.removesuffix("_i") for symbol in first.own),
        first=first,
        second=second,
        parameters=tuple(plain[s] for s in parameters),
        defaults=tuple(s.value for s in parameters),
        self_term=self_term,
        pair_term=pair,
        domain=tuple(tidied[f"domain[{k}]"] for k in range(len(system.domain))),
        limit=limit,
        smooth=smooth,
        duration=tidied["duration"],
        steps=problem.steps,
        points=Path(problem.points).as_posix() if isinstance(problem, Connect) else "",
        path=_guessed_path(problem, first, second) if isinstance(problem, Connect) else (),
        passive=isinstance(problem, Connect) and problem.passive,
        parallel=isinstance(problem, Connect) and problem.parallel,
        start=start,
        own_values=own_values,
        unused=tuple(s.name for s in declared if isinstance(s, Parameter) and s not in present),
    )


def _plain_symbols(
    pair: tuple[Particle, Particle], parameters: Sequence[Parameter], task: str
) -> dict[Quantity, Symbol]:
    """Return the symbol of the model for each quantity; names that generated code needs get a mark."""
    task = "particles" if task == "simulate" else task
    of_particles = [s for one in pair for s in (*one.q, *one.p, *one.own)]
    names = {symbol.name[:-2] for symbol in of_particles} | {symbol.name for symbol in parameters}
    plain: dict[Quantity, Symbol] = {
        p: Symbol(identifiers.marked(p.name, task, names, moving=False), real=True) for p in parameters
    }
    for symbol in of_particles:
        moving = not any(symbol in one.own for one in pair)
        name = identifiers.marked(symbol.name[:-2], task, names, moving=moving)
        plain[symbol] = Symbol(f"{name}{symbol.name[-2:]}", real=True)
    return plain


def _guessed_path(problem: Connect, first: ParticleSymbols, second: ParticleSymbols) -> tuple[Expr, ...]:
    if problem.path is None:
        return tuple(x + FRACTION * (y - x) for x, y in zip(first.q, second.q, strict=True))
    path = tuple(
        expressions.tidied(expressions.checked(position, f"path[{axis}]"))
        for axis, position in enumerate(problem.path(first.q, second.q, FRACTION))
    )
    if len(path) != len(first.q):
        raise ExpressionError(f"path gives {len(path)} coordinates", f"give {len(first.q)}")
    return path


def _particles_at_start(problem: Simulate, one: Particle) -> tuple[tuple[Table, Table], Table]:
    """Return the initial (q, p) and the own parameters of all particles; raise BoundaryError for unfit values."""
    for key in problem.start:
        if key not in (*one.q, *one.p, *one.own):
            raise BoundaryError(f"start gives {key}", "give coordinates, momenta and own parameters of the first one")
    columns = {}
    for symbol in (*one.q, *one.p, *one.own):
        if symbol not in problem.start:
            raise BoundaryError(f"start lacks {symbol}", "a simulation needs the complete initial state")
        column = np.atleast_1d(np.asarray(problem.start[symbol], dtype=float))
        if column.ndim != 1 or not np.isfinite(column).all():
            raise BoundaryError(f"start of {symbol} is no row of finite numbers", "give one number for each particle")
        columns[symbol] = column
    sizes = {column.size for column in columns.values()}
    if len(sizes) > 1:
        raise BoundaryError("start has different numbers of particles", "give as many values of each quantity")

    def table(symbols: Sequence[ParticleQuantity]) -> Table:
        rows = np.stack([columns[s] for s in symbols], axis=1) if symbols else np.empty((sizes.pop(), 0))
        return tuple(tuple(map(float, row)) for row in rows)

    return (table(one.q), table(one.p)), table(one.own)
