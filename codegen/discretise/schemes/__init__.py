"""The registry of schemes: find a scheme by its name and its method."""

from __future__ import annotations

from collections.abc import Collection

from sympy import Rational

from codegen.discretise.schemes import compositions, low_order, runge_kutta
from codegen.discretise.schemes.base import FIRST_ORDER, PARTICLES, Scheme
from codegen.errors import SchemeError, nearest

__all__ = ["ALIASES", "FIRST_ORDER", "METHODS", "PARTICLES", "Scheme", "find", "of_method"]

_FAMILIES = (low_order, runge_kutta, compositions)
"""The modules of the families, each with its SCHEMES by method; messages list schemes in this order."""
_ALL: dict[str, dict[str, Scheme]] = {
    method: {scheme.name: scheme for family in _FAMILIES for scheme in family.SCHEMES.get(method, ())}
    for method in ("variational", "hamiltonian", FIRST_ORDER, PARTICLES)
}
METHODS = {method: _ALL[method] for method in ("variational", "hamiltonian")}
"""Every scheme for mechanical systems by method and name; the tests cover this table."""

ALIASES = {
    ("variational", "stormer-verlet"): "trapezoidal",
    ("variational", "gauss-2"): "midpoint",
    ("hamiltonian", "gauss-2"): "midpoint",
    (FIRST_ORDER, "gauss-2"): "midpoint",
    ("variational", "lobatto-2"): "trapezoidal",
    ("hamiltonian", "lobatto-2"): "stormer-verlet",
    ("hamiltonian", "forest-ruth"): "yoshida-4",
}
"""Other names of schemes, by method."""


def find(name: str, method: str, methods: Collection[str] = ()) -> Scheme:
    """Return the named scheme for a method; raise SchemeError, with suggestions, for other names.

    A suggestion is one of the `methods` that the problem has.

    `alpha-<a>`, with a decimal or fraction a in [0, 1], is a scheme of the alpha family. `<composition>-of-<base>`,
    such as yoshida-4-of-midpoint, is a composition of a symmetric base scheme of order 2. `<n>-steps-of-<base>`, such
    as 4-steps-of-rk4, is n equal steps of a base scheme in one step.
    """
    table = _ALL[method]
    name = ALIASES.get((method, name), name)
    if name in table:
        return table[name]
    if "-steps-of-" in name:
        count, inner = name.split("-steps-of-", 1)
        base = find(inner, method)
        if base.parts or base.adaptive:
            single = [n for n, scheme in _ALL[method].items() if not scheme.parts and not scheme.adaptive]
            raise SchemeError(f"scheme {name!r} repeats {base.name}", f"repeat one of {', '.join(single)}")
        if not count.isdecimal() or int(count) < 2:
            raise SchemeError(f"scheme {name!r}", f"give a number of steps from 2 on, as in 4-steps-of-{inner}")
        return compositions.repeated(int(count), base)
    if "-of-" in name:
        outer, inner = name.split("-of-", 1)
        bases = {n: s for n, s in _ALL[method].items() if s.symmetric and s.order == 2}
        symmetric = bases.get(ALIASES.get((method, inner), inner))
        composition = compositions.composed(outer, symmetric) if symmetric else None
        if composition is None:
            raise SchemeError(
                f"there is no scheme {name!r} for the {method} method",
                f"give one of {', '.join(compositions.NAMES)}, then -of-, then one of {', '.join(bases)}",
            )
        return composition
    if method == "hamiltonian" and name.startswith("alpha-"):
        try:
            value = Rational(name.removeprefix("alpha-"))
        except (TypeError, ValueError, ZeroDivisionError):
            value = Rational(-1)
        if value.is_finite and 0 <= value <= 1:
            return low_order.alpha(value)
        raise SchemeError(f"scheme {name!r}", "give alpha-<a> with a between 0 and 1, as in alpha-0.25")
    elsewhere = [other for other, schemes in METHODS.items() if name in schemes]
    if method == FIRST_ORDER and (elsewhere or name.startswith("alpha-")):
        raise SchemeError(f"scheme {name!r} needs positions and momenta", f"use one of {', '.join(table)}")
    if elsewhere:
        instead = next((f"--method {other}, or " for other in elsewhere if other in methods), "")
        raise SchemeError(
            f"scheme {name!r} does not belong to the {method} method", f"use {instead}one of {', '.join(table)}"
        )
    offered = table if method == FIRST_ORDER else [n for names in METHODS.values() for n in names]
    raise SchemeError(f"there is no scheme {name!r}", nearest(name, offered, f"use one of {', '.join(table)}"))


def is_known(name: str, method: str) -> bool:
    """Return True if `find` finds the scheme."""
    try:
        return bool(find(name, method))
    except SchemeError:
        return False


def of_method(method: str) -> tuple[Scheme, ...]:
    """Return every scheme of a method that has its own name, without aliases, alpha schemes and other compositions."""
    return tuple(_ALL[method].values())
