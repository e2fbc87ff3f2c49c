"""Check of a step with rotations: its momenta are the derivatives of the discrete action along rotations.

The discrete Lagrangian is evaluated from the author's L(q, dq): the attitude moves between two quaternions with the
angular velocity of the retraction tan(angle/4) = |h w|/4. The derivatives are differences in 120 digits, along
rotations of one end in the frame of the body. The check uses none of the formulas of `discretise.rotations`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import mpmath
import numpy as np
from sympy import Symbol

from codegen.discretise.interval import STEP, repeated
from codegen.discretise.model import legendre
from codegen.discretise.model.definitions import Model
from codegen.discretise.program import StepProgram
from codegen.discretise.schemes.base import DiscreteLagrangian
from codegen.evidence.checks.base import DIGITS, Agreement, Context, Finding, does_not_apply, function_of
from codegen.problem.rotations import conjugate, product

_INCREMENT = mpmath.mpf(10) ** -40
_POINTS = 3
_LENGTH, _TIME = mpmath.mpf("0.1"), mpmath.mpf("0.3")  # the step length h and the time at the left node
Node = Mapping[Symbol, Any]  # the numbers of all coordinates at a node
Quaternion = tuple[Symbol, ...]


def check_rotating_momenta(context: Context, program: StepProgram) -> Iterator[Finding]:
    """Compare the equations for momenta at both nodes with the derivatives of the discrete action."""
    model = legendre.lagrangian_form(context.model.with_free_ends)
    if any(model.force) or len(model.holonomic) > len(model.rotations):
        reason = "forces and joints are no part of the discrete action; `problem as written` compares the motion"
        yield does_not_apply("momentum matching", reason)
        return
    action = _Action(model, repeated(context.scheme)[1].discrete_lagrangian())
    symbols = [*program.left_symbols, *program.stage_symbols, *program.right_symbols, STEP, *program.lengths]
    symbols = list(dict.fromkeys([*symbols, model.time, *model.parameters]))
    equations = dict(program.equations)
    values = function_of(symbols, list(equations.values()))
    generator, agreement = np.random.default_rng(5), Agreement(check="momentum matching")
    for _ in range(_POINTS):
        with mpmath.workdps(DIGITS):
            left, right = _random_nodes(model, generator)
            # With all momenta zero, the equations are the negative momenta of the discrete action.
            at: dict[Symbol, Any] = dict.fromkeys(symbols, mpmath.mpf(0))
            at |= dict(zip(program.left_symbols, left.values(), strict=False))
            at |= dict(zip(program.right_symbols, right.values(), strict=False))
            at |= dict(zip(program.stage_symbols, action.rates(left, right), strict=True))
            at |= dict(zip(model.parameters, action.parameters, strict=True)) | {model.time: _TIME}
            at |= dict.fromkeys((STEP, *program.lengths), _LENGTH)
            found = dict(zip(equations, values(*(at[s] for s in symbols)), strict=True))
            exact = dict(action.momenta(left, right, program.stage_symbols))
            agreement.compare(list(exact), [float(found[name]) for name in exact], list(exact.values()))
    yield agreement.finding("momenta of rotations", "derivatives of the discrete action along rotations")


def _random_nodes(model: Model, generator: np.random.Generator) -> tuple[Node, Node]:
    """Return two near nodes, whose quaternions have length one."""
    first, second = ([mpmath.mpf(float(x)) for x in generator.uniform(-1, 1, len(model.coordinates))] for _ in "01")
    left: dict[Symbol, Any] = dict(zip(model.coordinates, first, strict=True))
    right = {q: x + y / 4 for (q, x), y in zip(left.items(), second, strict=True)}
    for side in (left, right):
        for quaternion in model.rotations:
            side.update(zip(quaternion, _unit([side[q] for q in quaternion]), strict=True))
    return left, right


def _unit(vector: Sequence[Any]) -> list[Any]:
    length = mpmath.sqrt(sum(part**2 for part in vector))
    return [part / length for part in vector]


def _turn(quaternion: Quaternion, left: Node, right: Node) -> list[Any]:
    """Return b, tan(angle/4) times the axis of the rotation from the left to the right node."""
    c = product(conjugate([left[q] for q in quaternion]), [right[q] for q in quaternion])
    return [part / (1 + c[0]) for part in c[1:]]


def _slope(function: Callable[[Any], Any]) -> Any:
    return (function(_INCREMENT) - function(-_INCREMENT)) / (2 * _INCREMENT)


class _Action:
    """The discrete Lagrangian as a function of two nodes."""

    def __init__(self, model: Model, rule: DiscreteLagrangian) -> None:
        self.model, self.rule = model, rule
        turning = {q for quaternion in model.rotations for q in quaternion}
        self.places = [x for x in model.coordinates if x not in turning]
        self.parameters = [mpmath.mpf(x) for x in model.defaults]
        symbols = [*model.coordinates, *model.rates, model.time, *model.parameters]
        self.lagrangian = function_of(symbols, [model.function])

    def rates(self, left: Node, right: Node) -> list[Any]:
        """Return the velocities of positions and the angular velocities of a step."""
        velocities = [(right[x] - left[x]) / _LENGTH for x in self.places]
        turns = (part for quaternion in self.model.rotations for part in _turn(quaternion, left, right))
        return [*velocities, *(4 * part / _LENGTH for part in turns)]

    def of(self, left: Node, right: Node) -> Any:
        """Return the discrete Lagrangian."""
        total = mpmath.mpf(0)
        for point in self.rule.points:
            c = mpmath.mpf(point.abscissa.p) / point.abscissa.q
            here = {x: left[x] + c * (right[x] - left[x]) for x in self.places}
            rates = {x: (right[x] - left[x]) / _LENGTH for x in self.places}
            for quaternion in self.model.rotations:
                b = _turn(quaternion, left, right)
                factor = {0: (1, 0, 0, 0), 1: (1 - sum(x**2 for x in b), *(2 * x for x in b))}.get(c, (1, *b))
                at = _unit(product([left[q] for q in quaternion], factor))
                moving = product(at, (0, *(2 * x / _LENGTH for x in b)))
                here |= dict(zip(quaternion, at, strict=True))
                rates |= dict(zip(quaternion, moving, strict=True))
            state = [*(here[q] for q in self.model.coordinates), *(rates[q] for q in self.model.coordinates)]
            weight = _LENGTH * point.weight.p / point.weight.q
            total += weight * self.lagrangian(*state, _TIME + c * _LENGTH, *self.parameters)[0]
        return total

    def momenta(self, left: Node, right: Node, stages: Sequence[Symbol]) -> Iterator[tuple[str, Any]]:
        """Yield the names of the equations for momenta, and the negative momenta."""
        for x in self.places:
            yield f"left momentum of {x}", _slope(partial(self._shifted, (left, right), 0, x))
            yield f"right momentum of {x}", -_slope(partial(self._shifted, (left, right), 1, x))
        rates = iter(stages[len(self.places) :])
        for quaternion in self.model.rotations:
            first, last = (
                [_slope(partial(self._turned, (left, right), end, quaternion, axis)) for axis in range(3)]
                for end in (0, 1)
            )
            yield from ((f"left momentum of {next(rates)}", slope) for slope in first)
            momentum = product([right[q] for q in quaternion], (0, *last))
            yield from ((f"right momentum of {q}", -2 * p) for q, p in zip(quaternion, momentum, strict=True))

    def _shifted(self, nodes: tuple[Node, Node], end: int, x: Symbol, size: Any) -> Any:
        moved = {**nodes[end], x: nodes[end][x] + size}
        return self.of(*(moved if i == end else node for i, node in enumerate(nodes)))

    def _turned(self, nodes: tuple[Node, Node], end: int, quaternion: Quaternion, axis: int, angle: Any) -> Any:
        """Return the discrete Lagrangian after a small turn of one end about an axis of the body."""
        change = [mpmath.mpf(i == axis) * angle / 2 for i in range(3)]
        turned = _unit(product([nodes[end][q] for q in quaternion], (1, *change)))
        moved = {**nodes[end], **dict(zip(quaternion, turned, strict=True))}
        return self.of(*(moved if i == end else node for i, node in enumerate(nodes)))
