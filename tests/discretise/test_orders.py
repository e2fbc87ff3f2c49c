"""Orders of schemes from their coefficients alone: rooted trees, and words in two letters for compositions."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import mpmath
import numpy as np
import pytest
import sympy
from simulation_systems import model_of, module_of

import codegen
from codegen.discretise import schemes
from codegen.discretise.interval import LENGTHS, STEP
from codegen.discretise.particles import PARTICLE_SCHEMES
from codegen.discretise.schemes.base import Tableau
from codegen.discretise.transcribe import transcribe
from codegen.emit.naming import Choices
from codegen.errors import ArgumentError, SchemeError
from codegen.evidence.checks.one_step import has_symplectic_table
from codegen.solving.compiler import generate
from codegen.solving.drivers.fsolve import simulate as fsolve
from codegen.solving.results.result import Run

PROBLEMS = Path(__file__).parents[2] / "problems"
_MECHANICAL, _FIRST_ORDER = (schemes.of_method(method) for method in ("hamiltonian", schemes.FIRST_ORDER))
STEPS = [
    scheme
    for scheme in dict.fromkeys((*_MECHANICAL, *_FIRST_ORDER, *PARTICLE_SCHEMES.values()))
    if not (scheme.parts or scheme.adaptive)
]
COMPOSITIONS = [scheme for scheme in _MECHANICAL if scheme.parts]

# ---- Runge-Kutta methods: the order conditions of rooted trees (Hairer, Lubich and Wanner 2006, III.1 and III.2) ----

Tree = tuple[Any, ...]
"""The subtrees at a root; a leaf is ()."""


@cache
def trees(size: int) -> tuple[Tree, ...]:
    """All rooted trees with that many vertices."""
    return tuple(dict.fromkeys(tuple(sorted(forest)) for forest in _forests(size - 1)))


def _forests(size: int) -> Iterator[tuple[Tree, ...]]:
    if size == 0:
        yield ()
    for first in range(1, size + 1):
        for tree, rest in itertools.product(trees(first), list(_forests(size - first))):
            yield (tree, *rest)


def order_of(tree: Tree) -> int:
    return 1 + sum(order_of(branch) for branch in tree)


def density(tree: Tree) -> int:
    return order_of(tree) * math.prod(density(branch) for branch in tree)


def elementary_weights(tree: Tree, tables: Sequence[sympy.Matrix]) -> Iterator[sympy.Matrix]:
    """prod over branches of A phi(branch), with each of the tables in place of A at each vertex but the root."""
    stages = tables[0].rows
    choices = [
        [(table * inner).applyfunc(sympy.expand) for table in tables for inner in elementary_weights(branch, tables)]
        for branch in tree
    ]
    for chosen in itertools.product(*choices):
        yield sympy.Matrix([sympy.expand(sympy.prod([c[i] for c in chosen])) for i in range(stages)])


def satisfied(table: Tableau, order: int) -> bool:
    """Whether all conditions of trees with that many vertices hold, exactly."""
    tables = list(dict.fromkeys(sympy.ImmutableMatrix(rows) for rows in (table.positions, table.momenta)))
    weights = sympy.Matrix([table.weights])
    return all(
        sympy.expand((weights * phi)[0] - sympy.Rational(1, density(tree))) == 0
        for tree in trees(order)
        for phi in elementary_weights(tree, tables)
    )


def test_there_are_as_many_trees_as_textbooks_say() -> None:
    assert [len(trees(n)) for n in range(1, 8)] == [1, 1, 2, 4, 9, 20, 48]


@pytest.mark.parametrize("scheme", STEPS, ids=lambda scheme: scheme.name)
def test_tables_have_their_order_and_no_higher_one(scheme: schemes.Scheme) -> None:
    assert all(satisfied(scheme.step().tableau, order) for order in range(1, scheme.order + 1))
    assert not satisfied(scheme.step().tableau, scheme.order + 1)


@pytest.mark.parametrize("scheme", STEPS, ids=lambda scheme: scheme.name)
def test_tables_are_symplectic_where_that_is_claimed(scheme: schemes.Scheme) -> None:
    assert has_symplectic_table(scheme.step().tableau) == scheme.symplectic


@pytest.mark.parametrize("scheme", STEPS, ids=lambda scheme: scheme.name)
def test_tables_are_symmetric_where_that_is_claimed(scheme: schemes.Scheme) -> None:
    """a_{s+1-i,s+1-j} + a_ij = b_j (Hairer, Lubich and Wanner 2006, theorem V.2.3)."""
    tableau = scheme.step().tableau
    last, b = len(tableau.weights) - 1, tableau.weights
    differences = [
        sympy.expand(table[last - i][last - j] + table[i][j] - b[j])
        for table in (tableau.positions, tableau.momenta)
        for i in range(last + 1)
        for j in range(last + 1)
    ]
    assert (not any(differences)) == scheme.symmetric


# ---- Compositions: exp(a A) exp(b B) ... is exp(A + B) up to words of the order's length ----


def product_of_exponentials(letters: Sequence[tuple[str, Any]], longest: int) -> dict[str, Any]:
    """Coefficients of all words up to a length in the product of exp(coefficient letter)."""
    words = {"": mpmath.mpf(1)}
    for letter, coefficient in letters:
        powers = [coefficient**k / math.factorial(k) for k in range(longest + 1)]
        product: dict[str, Any] = {}
        for word, value in words.items():
            for k in range(longest - len(word) + 1):
                product[word + letter * k] = product.get(word + letter * k, 0) + value * powers[k]
        words = product
    return words


def largest_errors(scheme: schemes.Scheme, longest: int) -> list[float]:
    """For each length of words in position-verlet's drifts A and kicks B, against exp(A + B)."""
    letters = []
    for row in scheme.parts:
        first, second = (mpmath.mpf(str(sympy.N(f, 40))) for f in row)
        letters += [("A", first), ("B", first + second), ("A", second)]
    words, errors = product_of_exponentials(letters, longest), []
    for length in range(1, longest + 1):
        of_length = ("".join(word) for word in itertools.product("AB", repeat=length))
        exact = mpmath.mpf(1) / math.factorial(length)
        errors.append(float(max(abs(words.get(word, 0) - exact) for word in of_length)))
    return errors


@pytest.mark.parametrize("scheme", COMPOSITIONS, ids=lambda scheme: scheme.name)
def test_compositions_have_their_order_and_no_higher_one(scheme: schemes.Scheme) -> None:
    """A symmetric composition of even order p has an error of words of length p + 1."""
    assert scheme.part(LENGTHS, STEP).name == "position-verlet"
    with mpmath.workdps(40):
        *errors, leading = largest_errors(scheme, scheme.order + 1)
    assert max(errors) < 1e-22
    assert leading > 1e-9


@pytest.mark.parametrize("scheme", COMPOSITIONS, ids=lambda scheme: scheme.name)
def test_compositions_are_symmetric(scheme: schemes.Scheme) -> None:
    reversed_rows = tuple(tuple(row[::-1]) for row in scheme.parts[::-1])
    assert all(
        abs(sympy.N(a - b, 40)) < 1e-25
        for row, other in zip(scheme.parts, reversed_rows, strict=True)
        for a, b in zip(row, other, strict=True)
    )
    assert abs(sympy.N(sum(sum(row) for row in scheme.parts) - 1, 40)) < 1e-25


# ---- Names, refusals, long times ----


def test_other_names() -> None:
    assert schemes.find("gauss-2", "hamiltonian").name == schemes.find("gauss-2", "variational").name == "midpoint"
    assert schemes.find("lobatto-2", "hamiltonian").name == "stormer-verlet"
    assert schemes.find("forest-ruth", "hamiltonian").name == "yoshida-4"
    named = schemes.find("suzuki-4-of-trapezoidal", "variational")
    assert (named.name, named.order) == ("suzuki-4-of-trapezoidal", 4)
    assert schemes.find(named.name, "variational") == named


@pytest.mark.parametrize("name", ["yoshida-4-of-explicit-euler", "yoshida-4-of-gauss-4", "gauss-4-of-midpoint"])
def test_only_symmetric_schemes_of_order_two_are_composed(name: str) -> None:
    with pytest.raises(SchemeError, match=r"give one of yoshida-4, .* then -of-, then one of midpoint"):
        schemes.find(name, "hamiltonian")


@pytest.mark.parametrize("base", ["implicit-euler", "midpoint", "rk4", "radau-3", "gauss-4", "hermite-simpson"])
def test_repeated_steps_keep_the_order_of_their_base(base: str) -> None:
    """The table of the whole fulfils the order conditions, and holds that of the base at half its length."""
    whole, part = schemes.find(f"2-steps-of-{base}", schemes.FIRST_ORDER), schemes.find(base, schemes.FIRST_ORDER)
    tableau, own = whole.step().tableau, part.step().tableau
    count = len(own.weights)
    assert whole.order == part.order
    assert all(satisfied(tableau, order) for order in range(1, part.order + 1))
    for i in range(count):
        for j in range(count):
            for row, column in ((i, j), (count + i, count + j)):
                assert sympy.simplify(tableau.positions[row][column] - own.positions[i][j] / 2) == 0
            assert sympy.simplify(tableau.positions[count + i][j] - own.weights[j] / 2) == 0


@pytest.mark.parametrize("name", ["1-steps-of-rk4", "x-steps-of-rk4", "4-steps-of-yoshida-4", "4-steps-of-nothing"])
def test_only_single_schemes_are_repeated_and_more_than_once(name: str) -> None:
    with pytest.raises(SchemeError, match=r"from 2 on|repeat one of|no scheme 'nothing'"):
        schemes.find(name, schemes.FIRST_ORDER)


@pytest.mark.usefixtures("uncompiled")
def test_a_control_is_held_over_repeated_steps() -> None:
    """Nodes of an optimum are what the textbook's recursion makes of its controls, with two steps for each."""
    solution = codegen.solve(PROBLEMS / "van_der_pol.py", scheme="2-steps-of-rk4", steps=20)
    h, x = 5.0 / 40, np.array(solution.q[0])
    assert solution.status == "solved"

    def rates(y: Any, u: float) -> Any:
        return np.array([(1 - y[1] ** 2) * y[0] - y[1] + u, y[0]])

    for k, (u,) in enumerate(solution.u):
        for _ in range(2):
            one = rates(x, u)
            two = rates(x + h / 2 * one, u)
            three = rates(x + h / 2 * two, u)
            x = x + h / 6 * (one + 2 * two + 2 * three + rates(x + h * three, u))
        np.testing.assert_allclose(solution.q[k + 1], x, atol=1e-9)


@pytest.mark.slow
@pytest.mark.usefixtures("uncompiled")
@pytest.mark.parametrize("name", ["3-steps-of-rk4", "2-steps-of-hermite-simpson"])
def test_checks_prove_repeated_steps(name: str) -> None:
    findings = codegen.compile(PROBLEMS / "van_der_pol.py", scheme=name).check()
    assert findings.passed
    assert {row.check for row in findings} >= {"discrete equations", "consistency"}


def stiff(name: str) -> float:
    """The error after 20 steps of y' = -1e6 (y - cos t) - sin t from y = 1.5, whose solution soon is cos t.

    Source: Prothero and Robinson (1974), Mathematics of Computation 28.
    """
    y, t = codegen.state("y"), codegen.time()
    rate = -(10**6) * (y - sympy.cos(t)) - sympy.sin(t)
    result = codegen.solve(
        codegen.Control(dynamics={y: rate}, start={y: 1.5}, end={}, duration=2, steps=20), scheme=name
    )
    assert result.status == "solved"
    return float(result.q[-1, 0] - np.cos(2.0))


@pytest.mark.usefixtures("uncompiled")
@pytest.mark.parametrize("name", ["radau-3", "radau-5", "sdirk-4"])
def test_stiff_components_vanish_with_l_stable_schemes(name: str) -> None:
    assert abs(stiff(name)) < 1e-7


@pytest.mark.usefixtures("uncompiled")
@pytest.mark.parametrize("name", ["gauss-4", "gauss-8"])
def test_stiff_components_stay_with_gauss_collocation(name: str) -> None:
    """The stability function tends to 1 with an even number of points."""
    assert stiff(name) == pytest.approx(0.5, abs=0.01)


def test_first_order_systems_have_no_partitioned_schemes() -> None:
    for name in ("lobatto-4", "blanes-moan-4"):
        with pytest.raises(SchemeError, match="needs positions and momenta"):
            schemes.find(name, schemes.FIRST_ORDER)


def test_long_compositions_are_refused_in_control() -> None:
    with pytest.raises(SchemeError, match=r"kahan-li-8.*has 17 steps.*use gauss-4 or gauss-6"):
        generate(PROBLEMS / "linear_pendulum.py", {}, Choices("kahan-li-8", "hamiltonian"))
    with pytest.raises(SchemeError, match="composes discrete Lagrangians"):
        generate(PROBLEMS / "linear_pendulum.py", {}, Choices("yoshida-4-of-midpoint", "variational"))


def test_inner_points_do_not_meet_holonomic_constraints() -> None:
    with pytest.raises(SchemeError, match="holonomic constraints are not imposed"):
        generate(PROBLEMS / "spherical_pendulum.py", {}, Choices("gauss-4", "variational"))


def test_fsolve_does_not_solve_compositions() -> None:
    with pytest.raises(ArgumentError, match="makes 3 steps of another scheme"):
        fsolve(module_of("pendulum-hamiltonian", "hamiltonian", "yoshida-4-of-midpoint"), Run(5))


def test_a_composition_emits_its_base_once() -> None:
    """Code does not grow with the number of steps."""
    programs = [transcribe(model_of("pendulum-hamiltonian"), name) for name in ("yoshida-4", "kahan-li-8")]
    assert programs[0].equations == programs[1].equations
    assert [len(program.fractions) for program in programs] == [3, 17]


@pytest.mark.parametrize("scheme", ["gauss-4", "lobatto-4", "yoshida-6-of-midpoint", "blanes-moan-4"])
def test_energy_does_not_drift(scheme: str) -> None:
    """The trend of the error over the whole time is far below its oscillation; a short form of a benchmark."""
    solution = module_of("pendulum-hamiltonian", "hamiltonian", scheme).solve(1500, duration=600.0, start=(0.0, 1.4))
    error = solution.energy - solution.energy[0]
    slope = np.polyfit(solution.t, error, 1)[0] * solution.t[-1]
    assert solution.status == "solved"
    assert abs(slope) < 0.02 * (error.max() - error.min())


def test_energy_drifts_with_the_classical_method() -> None:
    solution = module_of("pendulum-hamiltonian", "hamiltonian", "rk4").solve(1500, duration=600.0, start=(0.0, 1.4))
    error = solution.energy - solution.energy[0]
    assert abs(np.polyfit(solution.t, error, 1)[0] * solution.t[-1]) > 0.5 * (error.max() - error.min())
