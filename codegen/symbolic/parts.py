"""The distinct parts of expressions: replacement, symbols and lengths without repeated visits of common parts.

Products of matrices repeat their entries. The torque of a friction force on a rolling body has 115 distinct parts, and
14 000 parts as a tree. The methods of sympy visit the tree; these functions visit every distinct part once.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from sympy import Basic, Expr, S, Symbol, fraction


def parts(expression: Basic) -> Iterator[Basic]:
    """Yield the distinct parts of an expression, from the outside to the inside, in the order of first occurrence."""
    seen, waiting = {expression}, [expression]
    while waiting:
        part = waiting.pop()
        yield part
        for argument in reversed(part.args):
            if argument not in seen:
                seen.add(argument)
                waiting.append(argument)


def symbols_of(expression: Basic) -> set[Symbol]:
    """Return the symbols of an expression without sums, integrals and other parts that bind symbols."""
    return {part for part in parts(expression) if isinstance(part, Symbol)}


def replaced(expression: Expr, values: Mapping[Expr, Expr]) -> Expr:
    """Return `expression.xreplace(values)`."""
    known: dict[Basic, Basic] = dict(values)

    def value(part: Basic) -> Basic:
        if part not in known:
            arguments = [value(argument) for argument in part.args]
            is_same = all(new is old for new, old in zip(arguments, part.args, strict=True))
            known[part] = part if is_same else part.func(*arguments)
        return known[part]

    return value(expression)


def operations(expression: Expr) -> int:
    """Return `expression.count_ops()`, the number of operations of the expression as a tree."""
    numbers: dict[Basic, int] = {}

    def number(part: Basic) -> int:
        if part not in numbers:
            numbers[part] = counted(part)
        return numbers[part]

    def counted(part: Basic) -> int:
        total = 0
        if part.is_Rational:
            return int(part.p < 0) + int(part.q != 1) if part is not S.One else 0
        if part.is_Add:  # x - y is one operation, and -x - y two
            negative = [_is_negative(term) for term in part.args]
            terms = (-term if sign else term for term, sign in zip(part.args, negative, strict=True))
            return len(part.args) - 1 + all(negative) + sum(map(number, terms))
        if part.is_Mul:
            if _is_negative(part):
                total, part = 1, -part
            above, below = fraction(part)
            if above.is_Integer:
                return total + 1 + int(above.p < 0) + number(below)
            if below is not S.One:
                return total + 1 + number(above) + (0 if below.is_Integer else number(below))
        if part.is_Pow and (part.exp is S.NegativeOne or part.base is S.Exp1):
            return total + 1 + number(part.base if part.exp is S.NegativeOne else part.exp)
        if part is S.Exp1:
            return total + 1
        if part.is_Mul:
            total += len(part.args) - 1
        elif part.args and (part.is_Pow or part.is_Function):
            total += 1
        return total + sum(map(number, part.args))

    return number(expression)


def _is_negative(part: Basic) -> bool:
    """Return True for a negative number, and for a product with a negative number as its first factor."""
    first = part.args[0] if part.is_Mul else part
    return bool(first.is_Number and first.is_extended_negative)
