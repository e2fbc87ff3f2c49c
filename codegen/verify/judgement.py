"""Emitted values against exact ones: what differs by more than rounding is looked at again with many digits."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import mpmath
import numpy as np

from codegen.errors import VerificationError
from codegen.verify import arithmetic
from codegen.verify.multiprecision import DIGITS, TOLERANCE, Sized
from codegen.verify.tape import Arithmetic

_RELATIVE = 1e-9
_ROUNDING = 100.0
"""A difference counts if it is that many times as large as the change from extended to double precision."""
_OPINIONS = 12

Evaluate = Callable[[Any], tuple[Any, Any]]
"""Emitted and exact values, arrays (points, entries), in a complex type of numpy."""
Opinion = Callable[[int, int], tuple[Sized, Any, Any]]
"""Of an entry at a point: what the text says with many digits, what is right, and how surely."""


def complex_numbers(kind: Any) -> Arithmetic:
    """Arithmetic of complex arrays of a precision."""
    real = np.longdouble if kind is np.clongdouble else np.float64
    return Arithmetic(
        number=lambda digits: real(digits),
        function=arithmetic.named,
        power=arithmetic.power,
        maximum=arithmetic.maximum,
        minimum=arithmetic.minimum,
        absolute=arithmetic.absolute,
        sign=arithmetic.sign,
        where=arithmetic.where,
        real=lambda value: np.asarray(value).real,
    )


def step_of(kind: Any) -> Any:
    """The imaginary step of a precision: products of two are nothing beside 1, and a small slope is not lost."""
    limits = np.finfo(kind)
    return limits.tiny ** limits.dtype.type(0.25)


def judge(names: Sequence[str], evaluate: Evaluate, opinion: Opinion) -> None:
    """Raise VerificationError for an entry that is wrong at some point; `names` say what the entries are.

    Where values differ, those that differ at most points are judged first, each where it differs most. A point without
    a value says nothing.
    """
    with np.errstate(all="ignore"):
        emitted, exact = evaluate(np.clongdouble)
        size = np.maximum(abs(emitted), abs(exact))
        odd = abs(emitted - exact) > _RELATIVE * size
        odd = (odd & np.isfinite(size)) | (np.isfinite(emitted) != np.isfinite(exact))
        if not odd.any():
            return
        rough, roughly = evaluate(np.complex128)
        odd &= ~(abs(emitted - exact) <= _ROUNDING * (abs(emitted - rough) + abs(exact - roughly)))
        relative = np.nan_to_num(abs(emitted - exact) / size, nan=1.0)
    for entry in sorted(np.flatnonzero(odd.any(axis=0)), key=lambda e: -odd[:, e].sum())[:_OPINIONS]:
        for point in sorted(np.flatnonzero(odd[:, entry]), key=lambda p: -relative[p, entry])[:2]:
            _require_right(names[int(entry)], int(entry), int(point), opinion)


def _require_right(name: str, entry: int, point: int, opinion: Opinion) -> None:
    try:
        with mpmath.workdps(DIGITS):
            found, exact, error = opinion(entry, point)
            differs = not abs(found.value - exact) <= TOLERANCE * found.size + 10 * error
            said, right = mpmath.nstr(found.value, 8), mpmath.nstr(exact, 8)
    except (ValueError, TypeError, ArithmeticError):  # no value there with more digits
        return
    if differs:
        raise VerificationError(
            f"the emitted code gives {said} for {name}, where {right} is right",
            "this is a defect of codegen, and nothing was written; please report it with the problem file",
        )
