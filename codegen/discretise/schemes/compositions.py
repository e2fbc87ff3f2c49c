"""Compositions: schemes of higher order, made of steps of a symmetric scheme of order 2 with different lengths.

For any symmetric scheme S of order 2, S(g_s h) ... S(g_1 h) with g_i = g_{s+1-i} has order 4, 6 or 8 if the g_i satisfy
the order conditions (Hairer, Lubich and Wanner 2006, section V.3.2). A partitioned method alternates steps of
symplectic-euler-adjoint and symplectic-euler of lengths a_i h and b_i h. It is explicit for a separable Hamiltonian,
and has the same order for others (McLachlan 1995, On the numerical integration of ordinary differential equations by
symmetric composition methods, section 2). `tests/discretise/test_orders.py` verifies the orders.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from sympy import Expr, Integer, Rational, S, Symbol, sqrt

from codegen.discretise.schemes.base import FIRST_ORDER, DiscreteLagrangian, FieldPoint, Scheme, Step, Update
from codegen.discretise.schemes.low_order import ONE_STEPS, OneStep, Substep
from codegen.errors import SchemeError


@dataclass(frozen=True)
class Composition(Scheme):
    """Consecutive steps of a base scheme, whose lengths add up to h and may be negative."""

    base: Scheme

    @property
    def variational(self) -> bool:
        """True if the base is variational."""
        return self.base.variational

    @property
    def is_chain(self) -> bool:
        """True if steps of the base are chains."""
        return self.base.is_chain

    def part(self, lengths: Sequence[Symbol], step: Symbol) -> Scheme:
        """Return the base scheme; several `lengths` replace the lengths of its substeps."""
        if len(lengths) == 1:
            return self.base
        pairs = zip(self._base().substeps, lengths, strict=True)
        return replace(self._base(), substeps=tuple(replace(s, fraction=length / step) for s, length in pairs))

    def step(self) -> Step:
        """Return the consecutive steps of the base as one step; raise SchemeError for discrete Lagrangians."""
        if not isinstance(self.base, OneStep) and not self.variational:
            return _joined(self.base.step(), [fraction for (fraction,) in self.parts])
        base, substeps = self._base(), list[Substep]()
        for row in self.parts:
            fractions = row if len(row) == len(base.substeps) else [row[0] * s.fraction for s in base.substeps]
            substeps += [replace(s, fraction=f) for s, f in zip(base.substeps, fractions, strict=True)]
        return replace(base, substeps=tuple(substeps)).step()

    def discrete_lagrangian(self) -> DiscreteLagrangian:
        """Raise SchemeError: the sum of discrete Lagrangians would have to be stationary between the steps."""
        raise self._refusal()

    def _base(self) -> OneStep:
        if not isinstance(self.base, OneStep):
            raise self._refusal()
        return self.base

    def _refusal(self) -> SchemeError:
        kind = "discrete Lagrangians" if self.variational else self.base.name
        return SchemeError(
            f"scheme {self.name!r} composes {kind}, which is possible in simulations only",
            "use gauss-4 or gauss-6, or a composition with --method hamiltonian",
        )


def _joined(step: Step, fractions: Sequence[Expr]) -> Step:
    """Return one step that consists of consecutive copies of a step, with the `fractions` of its length."""
    size, count = len(step.abscissae), len(step.points)
    points, abscissae, updates = list[FieldPoint](), list[Expr](), (list[Update | None](), list[Update | None]())
    begin = S.Zero
    for number, fraction in enumerate(fractions):
        first, before, after = number * size, number * count, (len(fractions) - 1 - number) * count
        for point in step.points:
            position, momentum = (tuple((first + n, a) for n, a in own) for own in (point.position, point.momentum))
            points.append(FieldPoint(begin + fraction * point.abscissa, fraction * point.weight, position, momentum))
        for joined, own in zip(updates, (step.positions, step.momenta), strict=True):
            for update in own:
                weights = (S.Zero,) * before + update.weights + (S.Zero,) * after if update else ()
                joined.append(
                    Update(first + update.begin, fraction * update.fraction, weights) if update else None
                )  # fmt: skip
        abscissae += [begin + fraction * abscissa for abscissa in step.abscissae]
        begin += fraction
    return Step(tuple(points), tuple(updates[0]), tuple(updates[1]), tuple(abscissae))


def repeated(count: int, base: Scheme) -> Composition:
    """Return the scheme `<count>-steps-of-<base>`: `count` equal steps of the base in one step, with one control."""
    substeps = [s.fraction for s in base.substeps] if isinstance(base, OneStep) else [S.One]
    return Composition(
        name=f"{count}-steps-of-{base.name}",
        order=base.order,
        symmetric=base.symmetric,
        symplectic=base.symplectic,
        source=base.source,
        summary=f"{count} equal steps of {base.name}",
        base=base,
        parts=(tuple(Rational(1, count) * s for s in substeps),) * count,
    )


def _decimals(text: str) -> tuple[Expr, ...]:
    return tuple(Rational(number) for number in text.split())


_SYMMETRIC: dict[str, tuple[int, str, tuple[Expr, ...]]] = {
    "yoshida-4": (
        4,
        "Forest and Ruth (1990); Suzuki (1990); Yoshida (1990); Hairer, Lubich and Wanner (2006), (II.4.4)",
        (1 / (2 - Integer(2) ** Rational(1, 3)),),
    ),
    "suzuki-4": (
        4,
        "Suzuki (1990); Hairer, Lubich and Wanner (2006), (II.4.5)",
        (1 / (4 - Integer(4) ** Rational(1, 3)),) * 2,
    ),
    "yoshida-6": (
        6,
        "Yoshida (1990), solution A; Hairer, Lubich and Wanner (2006), (V.3.11)",
        _decimals("0.78451361047755726381949763 0.23557321335935813368479318 -1.17767998417887100694641568"),
    ),
    "kahan-li-6": (
        6,
        "Kahan and Li (1997); McLachlan (1995); Hairer, Lubich and Wanner (2006), section V.3.2",
        _decimals(
            "0.39216144400731413927925056 0.33259913678935943859974864 -0.70624617255763935980996482 "
            "0.08221359629355080023149045"
        ),
    ),
    "yoshida-8": (
        8,
        "Yoshida (1990); Suzuki and Umeno (1993); Hairer, Lubich and Wanner (2006), section V.3.2",
        _decimals(
            "0.74167036435061295344822780 -0.40910082580003159399730010 0.19075471029623837995387626 "
            "-0.57386247111608226665638773 0.29906418130365592384446354 0.33462491824529818378495798 "
            "0.31529309239676659663205666"
        ),
    ),
    "kahan-li-8": (
        8,
        "Kahan and Li (1997); Hairer, Lubich and Wanner (2006), section V.3.2",
        _decimals(
            "0.13020248308889008087881763 0.56116298177510838456196441 -0.38947496264484728640807860 "
            "0.15884190655515560089621075 -0.39590389413323757733623154 0.18453964097831570709183254 "
            "0.25837438768632204729397911 0.29501172360931029887096624"
        ),
    ),
}
"""Compositions of symmetric schemes of order 2: order, source, and the fractions before the middle fraction."""
NAMES = tuple(_SYMMETRIC)
"""The names of the compositions of any symmetric base scheme of order 2."""


def composed(name: str, base: Scheme) -> Composition | None:
    """Return the named composition of a base scheme; None for other names, or an unsuitable base."""
    if name not in _SYMMETRIC or not base.symmetric or base.order != 2:
        return None
    return _of(name, base, f"{name}-of-{base.name}")


def _of(composition: str, base: Scheme, name: str) -> Composition:
    order, source, half = _SYMMETRIC[composition]
    fractions = _mirrored(half, 2 * len(half) + 1)
    substeps = [s.fraction for s in base.substeps] if isinstance(base, OneStep) else [S.One]
    return Composition(
        name=name,
        order=order,
        symmetric=True,
        symplectic=base.symplectic,
        source=source,
        summary=f"{len(fractions)} steps of {base.name}",
        base=base,
        parts=tuple(tuple(g * s for s in substeps) for g in fractions),
    )


_EXPLICIT, _MIDPOINT = (
    next(scheme for scheme in ONE_STEPS if scheme.name == name) for name in ("position-verlet", "midpoint")
)


def _partitioned(name: str, order: int, source: str, drifts: tuple[Expr, ...], kicks: tuple[Expr, ...]) -> Composition:
    """Return the composition with the sequence drift, kick, drift, ... of the given fractions of h.

    It consists of steps of position-verlet with unequal halves. The first half of a step (symplectic-euler-adjoint)
    ends with one part of a kick, and the second half (symplectic-euler) begins with the other part.
    """
    rows, carried = list[tuple[Expr, ...]](), S.Zero
    for drift, kick in zip(drifts, kicks, strict=False):
        first = (drift - carried).expand()
        carried = (kick - first).expand()
        rows.append((first, carried))
    return Composition(
        name=name,
        order=order,
        symmetric=True,
        symplectic=True,
        source=source,
        summary=f"{len(rows)} steps of position-verlet, each of two unequal parts",
        base=_EXPLICIT,
        parts=tuple(rows),
    )


def _mirrored(half: tuple[Expr, ...], count: int) -> tuple[Expr, ...]:
    """Return a palindrome of `count` numbers with the sum 1 that starts with `half`; the middle completes the sum."""
    rest = 1 - 2 * sum(half, S.Zero)
    middle = (rest,) if count % 2 else (rest / 2, rest / 2)
    return (*half, *middle, *half[::-1])


_ROOT_19 = sqrt(Integer(19))

PARTITIONED = (
    _partitioned(
        "mclachlan-4",
        4,
        "McLachlan (1995), SIAM Journal on Scientific Computing 16, section 4: 5 stages",
        _mirrored(((14 - _ROOT_19) / 108, (20 - 7 * _ROOT_19) / 108), 6),
        _mirrored((Rational(2, 5), Rational(-1, 10)), 5),
    ),
    _partitioned(
        "blanes-moan-4",
        4,
        "Blanes and Moan (2002), Journal of Computational and Applied Mathematics 142, table 2: S6; digits beyond the "
        "15 printed follow from the order conditions",
        _mirrored(
            _decimals(
                "0.079203696431195669433663495888269 0.35317290604977398848106131157312 "
                "-0.042065080357719535368110298302517"
            ),
            7,
        ),
        _mirrored(_decimals("0.2095151066133620212740726400295 -0.14385177317981800827511505785653"), 6),
    ),
    _partitioned(
        "blanes-moan-6",
        6,
        "Blanes and Moan (2002), table 2: S10; digits beyond the 15 printed follow from the order conditions",
        _mirrored(
            _decimals(
                "0.050262764400392686021221654402074 0.41351430042834381506306372013388 "
                "0.045079889794398062968897052124513 -0.18805485381956891479912848891887 "
                "0.54196067845078013483141474093307"
            ),
            11,
        ),
        _mirrored(
            _decimals(
                "0.14881644790104323192090100553558 -0.13238586576778364744884542659894 "
                "0.067307604692184458150257896592601 0.43266640257817359752766797088355"
            ),
            10,
        ),
    ),
)

SCHEMES = {
    "hamiltonian": (*(_of(name, _EXPLICIT, name) for name in NAMES), *PARTITIONED),
    FIRST_ORDER: tuple(_of(name, _MIDPOINT, name) for name in NAMES),
}
"""Compositions of position-verlet, explicit where the Hamiltonian is separable, and of the midpoint rule."""
