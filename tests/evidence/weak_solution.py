"""The particle ansatz as a weak solution of the Euler-Poincare equations, proved by computer algebra.

With m = sum_i p_i delta(x - q_i) and v(x) = sum_j p_j G(x, q_j), the equations m_t + (v . grad) m + (grad v)' m
+ m div v = 0 are tested with a function psi that vanishes on the boundary with its normal derivative. By parts, and
because delta takes values, every integral becomes a sum over particles of values of psi, G and their derivatives at
particles; time derivatives are those of Hamilton's equations of H = 1/2 sum_ij p_i . p_j G(q_i, q_j).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from sympy import Derivative, Expr, Function, Rational, Subs, Symbol, diff, symbols

Kernel = Callable[[Sequence[Expr], Sequence[Expr]], Expr]
Test = Callable[[Sequence[Expr]], Expr]


def any_kernel(x: Sequence[Expr], y: Sequence[Expr]) -> Expr:
    """A kernel of which nothing is known but that its arguments may be exchanged."""
    G = Function("G")
    return (G(*x, *y) + G(*y, *x)) / 2


def any_test_function(x: Sequence[Expr]) -> Expr:
    """A test function of which nothing is known."""
    return Function("psi")(*x)


def weak_defect(
    kernel: Kernel = any_kernel,
    test: Test = any_test_function,
    particles: int = 2,
    dimension: int = 2,
    *,
    without: str = "",
) -> Expr:
    """The first component of the tested equations, a sum that vanishes identically if the ansatz solves them.

    It is an expression in the places q_i_a and momenta p_i_a, i from 1; `without` leaves out one of the terms rate,
    advection, stretching, divergence, which shows that each is needed.
    """
    x = symbols(f"x_1:{dimension + 1}", real=True)
    q = [symbols(f"q_{i}_1:{dimension + 1}", real=True) for i in range(1, particles + 1)]
    p = [symbols(f"p_{i}_1:{dimension + 1}", real=True) for i in range(1, particles + 1)]
    field = [sum(p[j][a] * kernel(x, q[j]) for j in range(particles)) for a in range(dimension)]
    energy = Rational(1, 2) * sum(
        _dot(p[i], p[j]) * kernel(q[i], q[j]) for i in range(particles) for j in range(particles)
    )
    psi = test(x)
    slopes = [diff(psi, place) for place in x]
    total: Expr = Rational(0)
    for i in range(particles):
        velocity = [diff(energy, momentum) for momentum in p[i]]
        along = sum(_at(s, x, q[i]) * v for s, v in zip(slopes, velocity, strict=True))
        spread = sum(diff(field[a], x[a]) for a in range(dimension))
        carried = psi * spread + sum(field[a] * slopes[a] for a in range(dimension))
        stretched = sum(diff(field[a], x[0]) * p[i][a] for a in range(dimension))
        terms = {
            "rate": -diff(energy, q[i][0]) * _at(psi, x, q[i]) + p[i][0] * along,
            "advection": -p[i][0] * _at(carried, x, q[i]),
            "stretching": _at(psi * stretched, x, q[i]),
            "divergence": p[i][0] * _at(psi * spread, x, q[i]),
        }
        total += sum(term for name, term in terms.items() if name != without)
    return total


def _dot(a: Sequence[Expr], b: Sequence[Expr]) -> Expr:
    return sum((x * y for x, y in zip(a, b, strict=True)), Rational(0))


def _at(expression: Expr, x: Sequence[Symbol], place: Sequence[Expr]) -> Expr:
    """The value at a place, with derivatives of unknown functions taken before the place is put in."""
    return expression.subs(dict(zip(x, place, strict=True)), simultaneous=True).doit()


def is_zero(defect: Expr) -> bool:
    """Whether a defect with unknown functions cancels term by term.

    Derivatives at repeated arguments, G_1(q, q), are `Subs` objects of sympy; each becomes a symbol of its own that is
    named after which slots are differentiated, so that equal ones cancel.
    """
    return bool(_named(defect.expand().doit()).expand() == 0)


def _named(expression: Expr) -> Expr:
    found = {part: _symbol(part) for part in expression.atoms(Subs) | expression.atoms(Derivative)}
    return expression.xreplace(found)


def _symbol(part: Expr) -> Symbol:
    """A symbol for the derivative of a function by its slots, at arguments."""
    inner, places = (
        (part.expr, dict(zip(part.variables, part.point, strict=True))) if isinstance(part, Subs) else (part, {})
    )
    function = inner.expr
    slots = sorted(function.args.index(variable) for variable, times in inner.variable_count for _ in range(times))
    arguments = [argument.subs(places) for argument in function.args]
    return Symbol(f"{function.func}_{slots}({arguments})")
