"""Defects planted in the package, one at a time, and the checks that find them.

    python tests/mutated_package.py NUMBER ...     the outcomes of defects, as JSON

A defect is a replacement of text in one source file. A process of its own imports the package with this text replaced,
derives a problem and checks its module. The files of the package do not change. The interpreter runs the module.
`evidence/test_mutants.py` takes some of these defects, `benchmarks/mutants.py` all.
"""

from __future__ import annotations

import argparse
import importlib
import json
import multiprocessing
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from enum import StrEnum
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from pathlib import Path

ROOT = Path(__file__).parents[1]
FEATURES = '''"""A mechanical problem with most of the conditions that an author may state."""

from sympy import Eq, cos, sin

from codegen import Control, control, coordinates, parameters, time


def problem() -> Control:
    (x, y), (dx, dy) = coordinates("x y")
    u, w = control("u"), control("w")
    m, k, c, limit, fuel, T, place, speed = parameters(
        m=1.3, k=0.7, c=0.4, limit=3, fuel=5, T=2, place=0.2, speed=0.6
    )
    t = time()
    return Control(
        lagrangian=m / 2 * (dx**2 + 2 * dy**2 + cos(x) * dx * dy / 3) - k * x**2 * y / 2 + m * sin(y),
        force={x: u - c * dx, y: w * x},
        cost=u**2 + w**2 * (1 + t) + x * dy**2 / 5,
        terminal_cost=y**2 + y * dy / 3,
        duration=T,
        start={x: place, dx: speed, y: 0.1},
        end={x: 1, dx: -speed / 2},
        bounds={u: (-limit, 2 * limit), dy: (-3 * limit, 4 * limit), y: (-5, 6)},
        start_conditions=[Eq(dy, 2 * y)],
        end_conditions=[y + dy / 4 <= 2],
        path=[u * x + dy <= 4 * limit],
        integral=[u**2 <= fuel],
        at={T / 2: [Eq(y, 0.3)]},
        steps=12,
    )
'''
EARNINGS = '''"""A first-order problem that maximises, with a free parameter at the end and a free duration."""

from codegen import Control, control, free_parameter, parameters, states


def problem() -> Control:
    a, b = states("a b")
    u = control("u")
    r, d = parameters(r=0.3, d=0.8)
    T = free_parameter("T", guess=2, lower=1, upper=4)
    goal = free_parameter("goal", guess=1.5, lower=d, upper=3)
    return Control(
        dynamics={a: b - r * a, b: u - d * a * b},
        maximise=a - u**2,
        terminal_maximise=r * b - T,
        duration=T,
        start={a: 1, b: 0.5},
        end={a: goal},
        bounds={u: (-2, 2), b: (-3, 5)},
        steps=12,
    )
'''
ORBIT = '''"""A periodic motion, whose Hamiltonian is given."""

from codegen import Control, canonical_pair, control, parameters


def problem() -> Control:
    q, p = canonical_pair("q", "p")
    u = control("u")
    m, k, T, turn = parameters(m=1.4, k=0.9, T=1.5, turn=0.5)
    return Control(
        hamiltonian=p**2 / (2 * m) + k * q**4 / 4 + q * p / 5,
        force={q: u},
        cost=u**2 + q**2,
        duration=T,
        periodic={q: turn, p: 0},
        bounds={u: (-9, 9)},
        steps=12,
    )
'''
MEMORY = '''"""A decay from the past, along a history that changes."""

from codegen import Control, control, parameters, states, time


def problem() -> Control:
    (x,) = states("x")
    u = control("u")
    (lag,) = parameters(lag=1)
    return Control(
        dynamics={x: -x.delayed(lag) + u},
        cost=x**2 + u**2,
        duration=2 * lag,
        start={x: 1},
        history={x: 1 + time() / 2},
        steps=12,
    )
'''
TEXTS = {"features": FEATURES, "earnings": EARNINGS, "orbit": ORBIT, "memory": MEMORY}
"""Problems that are in no file, by name."""


class Stage(StrEnum):
    """The stage of a build in which a defect is planted."""

    READING = "reading"
    TRANSCRIPTION = "transcription"
    DIFFERENTIATION = "differentiation"
    EMISSION = "emission"
    LAYOUT = "layout"


@dataclass(frozen=True)
class Mutant:
    """A defect: in `file` of the package the text `new` replaces the first occurrence of `old`.

    `what` says what is then wrong with the module of `problem`, a name in the gallery or in TEXTS. `scheme` and
    `method` are the choices of its build.
    """

    stage: Stage
    what: str
    file: str
    old: str
    new: str
    problem: str
    scheme: str | None = None
    method: str | None = None

    @property
    def path(self) -> Path:
        """The source file."""
        return ROOT / "codegen" / self.file


@dataclass(frozen=True)
class Outcome:
    """The first finder of a defect: "build", or the name of a check; `text` is its first finding.

    A defect survives if nothing has found it: the name is then empty. `seconds` is the time from the import of the
    package.
    """

    caught_by: str
    text: str
    seconds: float


_FORM = "discretise/model/normal_form.py"
_INTERVAL = "discretise/interval.py"
_DIFFERENTIATION = "emit/differentiation.py"
_LAYOUT = "emit/lower/control/layout.py"
_BOUNDS = "emit/lower/control/layout.py"
_KERNELS = "emit/lower/control/kernels.py"
_PRINTER = "emit/lower/printer.py"
_RATES = "tuple(map(fixed.get, rates))"
_ENDS = "fixed = dict(_pairs(entries, end))"


def _reading() -> Iterator[Mutant]:
    stage = Stage.READING
    force = 'force=per_coordinate("force") if not is_first_order'
    opposite = 'force=tuple(-f for f in per_coordinate("force")) if not is_first_order'
    cost = 'cost=value("cost") if is_control'
    yield Mutant(stage, "the sign of a force flipped", _FORM, force, opposite, "linear_pendulum")
    yield Mutant(stage, "the cost times two", _FORM, cost, 'cost=2 * value("cost") if is_control', "linear_pendulum")
    of_end = (
        f'{_ENDS}\n        fixed = {{s: v * sympy.Rational(101, 100) if end == "end" else v for s, v in fixed.items()}}'
    )
    yield Mutant(stage, "end values 1 % larger", _FORM, _ENDS, of_end, "linear_pendulum")
    duration = 'duration=value("duration"),'
    yield Mutant(stage, "the duration times two", _FORM, duration, 'duration=2 * value("duration"),', "linear_pendulum")
    function = "function=value(form) if not is_first_order"
    yield Mutant(stage, "the sign of the Lagrangian", _FORM, function, f"function=-{function[9:]}", "linear_pendulum")
    yield Mutant(stage, "the cost halved", _FORM, cost, 'cost=value("cost") / 2 if is_control', "bryson_denham")
    yield Mutant(
        stage, "velocities of an end exchanged", _FORM, _RATES, "tuple(map(fixed.get, rates[::-1]))", "orbital_transfer"
    )
    scaled = "tuple(v if v is None else v * sympy.Rational(101, 100) for v in map(fixed.get, rates))"
    yield Mutant(stage, "velocities of both ends 1 % larger", _FORM, _RATES, scaled, "orbital_transfer")
    both = 'lower, upper = dict(_pairs(entries, "lower bound")), dict(_pairs(entries, "upper bound"))'
    yield Mutant(
        stage, "lower and upper bounds exchanged", _FORM, both,
        f"{both}\n    lower, upper = {{s: -v for s, v in upper.items()}}, {{s: -v for s, v in lower.items()}}",
        "van_der_pol",
    )  # fmt: skip
    yield Mutant(
        stage, "upper bounds dropped", _FORM, "Bounds(s, lower.get(s), upper.get(s)) for s",
        "Bounds(s, lower.get(s), None) for s",
        "van_der_pol",
    )  # fmt: skip
    defaults = "defaults=tuple(p.value for p in kinds.parameters),"
    reverse = "defaults=tuple(p.value for p in kinds.parameters[::-1]),"
    yield Mutant(stage, "defaults of parameters exchanged", _FORM, defaults, reverse, "orbital_transfer")
    components = "tuple(components.get(x, sympy.S.Zero) for x in coordinates)"
    yield Mutant(
        stage, "the force of another coordinate", _FORM, components,
        components.replace("coordinates)", "coordinates[::-1])"), "orbital_transfer",
    )  # fmt: skip
    yield Mutant(
        stage,
        "the derivative of another state",
        _FORM,
        components,
        components.replace("coordinates)", "coordinates[::-1])"),
        "van_der_pol",
    )
    at_end = 'end, end_conditions = boundary("end")'
    yield Mutant(
        stage, "the start in place of the end", _FORM, at_end, at_end.replace('"end"', '"start"'), "orbital_transfer"
    )
    at_start = 'start, start_conditions = boundary("start")'
    yield Mutant(
        stage,
        "the end in place of the start",
        _FORM,
        at_start,
        at_start.replace('"start"', '"end"'),
        "orbital_transfer",
    )
    terminal = 'terminal_cost=value("terminal_cost"),'
    yield Mutant(stage, "the terminal cost dropped", _FORM, terminal, "", "cart_pole_balance")
    guesses = "FreeParameter(s, guesses[s], lower.get(s), upper.get(s))"
    yield Mutant(
        stage,
        "bounds of free parameters dropped",
        _FORM,
        guesses,
        "FreeParameter(s, guesses[s], None, None)",
        "earnings",
    )
    tied = 'Condition(f"{symbol} = {text(value)}", symbol - value) for symbol, value in tied.items()'
    yield Mutant(
        stage,
        "an end value of a free parameter twice as large",
        _FORM,
        tied,
        tied.replace("symbol - value)", "symbol - 2 * value)"),
        "earnings",
    )
    entry = "expression = expressions.tidied(entry.expression.xreplace(plain))"
    yield Mutant(
        stage,
        "decimal numbers rounded",
        _FORM,
        entry,
        f"{entry}.replace(lambda e: e.is_Rational and not e.is_Integer, lambda e: sympy.Rational(round(e, 1)))",
        "cart_pole_balance",
    )
    written = "discretise/model/normal_form.py"
    yield Mutant(
        stage, "a maximum read as a minimum", written,
        "yield replace(written, expression=-written.expression) if is_maximised else written",
        "yield written", "earnings",
    )  # fmt: skip
    relation = "discretise/model/relations.py"
    difference = 'difference = right - left if sign == ">=" else left - right'
    yield Mutant(stage, "inequalities turned round", relation, difference, difference.replace(">=", "<="), "low_thrust")
    definitions = "discretise/model/definitions.py"
    yield Mutant(
        stage, "bounds of velocities turned round", definitions, '[(-1, ">=", self.lower), (1, "<=", self.upper)]',
        '[(1, ">=", self.lower), (-1, "<=", self.upper)]', "features",
    )  # fmt: skip
    conditions = "discretise/conditions"
    added = "(*self.of_model(model), *self.conditions(entries))"
    yield Mutant(stage, "conditions dropped", f"{conditions}/base.py", added, "self.of_model(model)", "low_thrust")
    yield Mutant(
        stage,
        "conditions at both ends dropped",
        f"{conditions}/base.py",
        added,
        f"{added} if self.argument == 'path' else ()",
        "low_thrust",
    )
    limit = "Integral(entry.name, entry.expression, entry.equality, limit.expression)"
    yield Mutant(
        stage,
        "the limit of an integral doubled",
        f"{conditions}/integral.py",
        limit,
        limit.replace("limit.expression", "2 * limit.expression"),
        "features",
    )
    yield Mutant(
        stage, "inner times earlier", f"{conditions}/inner_times.py", "*(InnerTime(times[i]) for i in order)",
        "*(InnerTime(times[i] * Rational(3, 4)) for i in order)", "features",
    )  # fmt: skip
    yield Mutant(
        stage, "values at inner times larger by 0.1", f"{conditions}/inner_times.py",
        "InnerCondition(entry.name, entry.expression,",
        "InnerCondition(entry.name, entry.expression - Rational(1, 10),", "features",
    )  # fmt: skip
    yield Mutant(
        stage, "the window of a waypoint dropped", f"{conditions}/inner_times.py",
        "times[-1] = replace(times[-1], earliest=entry.expression)", "pass", "drone_gates",
    )  # fmt: skip
    yield Mutant(
        stage, "the shift of a periodic quantity halved", f"{conditions}/periodic.py",
        "return tuple((entry.key, entry.expression) for entry in entries",
        "return tuple((entry.key, entry.expression / 2) for entry in entries",
        "orbit",
    )  # fmt: skip
    chain = "discretise/model/from_problem.py"
    yield Mutant(
        stage,
        "jumps dropped",
        chain,
        "tuple((e.key, e.expression) for e in jump if",
        "tuple((e.key, e.key) for e in jump if",
        "bouncing_ball",
    )
    yield Mutant(
        stage,
        "a jump reversed",
        chain,
        "tuple((e.key, e.expression) for e in jump if",
        "tuple((e.key, -e.expression) for e in jump if",
        "bouncing_ball",
    )
    yield Mutant(
        stage,
        "the number of intervals doubled",
        _FORM,
        "steps=int(problem.steps),",
        "steps=2 * int(problem.steps),",
        "linear_pendulum",
    )
    yield Mutant(
        stage,
        "the start of a simulation 1 % off",
        _FORM,
        _ENDS,
        of_end.replace('"end" else', '"start" else'),
        "pendulum",
    )
    delays, past = "discretise/model/delays.py", "+ i * length - delay.lag})"
    later = past.replace("- delay", "+ delay")
    yield Mutant(stage, "values of the past from a later time", delays, past, later, "memory")
    earlier = "copies[i - back][delay.quantity]"
    yield Mutant(stage, "a delay dropped", delays, earlier, earlier.replace(" - back", ""), "delayed_oscillator")
    observed = "Observed(entry.name, entry.expression)"
    yield Mutant(
        stage,
        "measured expressions doubled",
        f"{conditions}/measurements.py",
        observed,
        observed.replace("entry.expression", "2 * entry.expression"),
        "published/predator_prey",
    )
    yield Mutant(stage, "the sign of a Hamiltonian", _FORM, function, f"function=-{function[9:]}", "pendulum")


def _transcription() -> Iterator[Mutant]:
    stage = Stage.TRANSCRIPTION
    legendre, forms = "discretise/model/legendre.py", "symbolic/derivatives.py"
    dual = "sympy.expand_mul(half, deep=False) - function.xreplace(at_rest)"
    yield Mutant(
        stage,
        "the potential of a Hamiltonian reversed",
        legendre,
        dual,
        dual.replace(" - f", " + f"),
        "linear_pendulum",
        None,
        "hamiltonian",
    )
    slope = "return tuple(slopes.get(symbol, sympy.S.Zero) for symbol in ordered)"
    yield Mutant(
        stage,
        "derivatives of the Lagrangian doubled",
        forms,
        slope,
        slope.replace("(slopes", "(2 * slopes"),
        "linear_pendulum",
    )
    force = "node[i] += weight * share * force_at(f, number, c)"
    yield Mutant(
        stage, "forces doubled", _INTERVAL, force, force.replace("+= weight", "+= 2 * weight"), "linear_pendulum"
    )
    yield Mutant(
        stage,
        "forces at one end of an interval alone",
        _INTERVAL,
        "minus, *between, plus = (tuple(node) for node in forces)",
        "minus, *between, plus = (tuple(node) for node in forces)\n"
        "    plus = minus if inner else tuple(sympy.S.Zero for _ in plus)",
        "linear_pendulum",
    )
    density = "[total + weight * at(f, c, here) for total, f in"
    yield Mutant(
        stage, "the cost without h", _INTERVAL, density, density.replace("weight", "point.weight"), "linear_pendulum"
    )
    when = "values[model.time] = model.time + sympy.expand(c * STEP)"
    yield Mutant(
        stage, "time at the start of an interval", _INTERVAL, when, "values[model.time] = model.time", "low_thrust"
    )
    yield Mutant(
        stage, "time twice as fast", _INTERVAL, when, when.replace("= model.time", "= 2 * model.time"), "low_thrust"
    )
    velocity = "(right - left) / self.step for left, right"
    yield Mutant(
        stage, "velocities reversed", _INTERVAL, velocity, velocity.replace("right - left", "left - right"), "features"
    )
    sign = "end.sign * multipliers[i] * p"
    yield Mutant(
        stage, "the momentum at the end reversed", "discretise/variational.py", sign, sign[11:], "linear_pendulum"
    )
    step = "equations.append(value - values[update.begin][x] - STEP * update.fraction * rate)"
    yield Mutant(
        stage, "a step in the other direction", _INTERVAL, step, step.replace("- STEP", "+ STEP"), "van_der_pol"
    )
    field = "*(f - slope for slope, f in forced)"
    yield Mutant(
        stage,
        "Hamilton's second equation reversed",
        _INTERVAL,
        field,
        "*(f + slope for slope, f in forced)",
        "pendulum",
    )
    scales = "{STEP: model.duration * STEP, model.time"
    yield Mutant(
        stage,
        "a free duration left out",
        "discretise/assembly.py",
        scales,
        "{STEP: STEP, model.time",
        "double_integrator",
    )
    imposed = "multiplier * sum(slack, value)"
    yield Mutant(
        stage,
        "conditions reversed",
        "discretise/conditions/ends.py",
        imposed,
        "multiplier * sum(slack, -value)",
        "low_thrust",
    )
    excess = "self.slack - self.condition.value"
    yield Mutant(
        stage,
        "the limit of an integral reversed",
        "discretise/program.py",
        excess,
        excess.replace("-", "+"),
        "features",
    )
    out = "out = End(element=terminal, cost=terminal)"
    yield Mutant(
        stage,
        "the terminal cost doubled",
        "discretise/conditions/ends.py",
        out,
        "out = End(element=2 * terminal, cost=2 * terminal)",
        "cart_pole_balance",
    )
    boundary = "values.append(BoundaryValue(where, quantity.name, symbol, value))"
    yield Mutant(
        stage,
        "boundary values 1 % larger",
        "discretise/forms.py",
        boundary,
        boundary.replace("value))", "value * 101 / 100))"),
        "orbital_transfer",
    )


def _differentiation() -> Iterator[Mutant]:
    stage = Stage.DIFFERENTIATION
    slope = "else sympy.diff(scalar, x) for i, x in enumerate(unknowns)"
    yield Mutant(
        stage, "the gradient doubled", _DIFFERENTIATION, slope, slope.replace("sympy", "2 * sympy"), "linear_pendulum"
    )
    entry = "hessian.append((row, column, value))"
    yield Mutant(
        stage,
        "the Hessian reversed",
        _DIFFERENTIATION,
        entry,
        "hessian.append((row, column, -value))",
        "linear_pendulum",
    )
    yield Mutant(
        stage,
        "entries of the Hessian left out",
        _DIFFERENTIATION,
        entry,
        f"{entry} if row != column else None",
        "orbital_transfer",
    )
    jacobian = "slopes = [[sympy.diff(r, y) for y in program.unknowns]"
    yield Mutant(
        stage,
        "the Jacobian of a step doubled",
        _DIFFERENTIATION,
        jacobian,
        jacobian.replace("[[", "[[2 * "),
        "pendulum",
    )
    stages = "of_stages = [-slopes[index] for index"
    yield Mutant(
        stage,
        "multipliers of stages reversed",
        _DIFFERENTIATION,
        stages,
        stages.replace("-s", "s"),
        "van_der_pol",
        "rk4",
    )
    quadratic = "linear_quadratic = (\n        program.controlled"
    yield Mutant(
        stage,
        "a nonlinear problem taken for linear",
        _DIFFERENTIATION,
        quadratic,
        quadratic.replace("program", "True or program"),
        "orbital_transfer",
    )
    cost = "return ElementDerivatives(tuple(unknowns), gradient, tuple(hessian), cost)"
    yield Mutant(
        stage,
        "the cost of an interval doubled",
        _DIFFERENTIATION,
        cost,
        cost.replace(" cost", " 2 * cost"),
        "linear_pendulum",
    )


def _emission() -> Iterator[Mutant]:
    stage = Stage.EMISSION
    decimal = "decimal = repr(p / q)"
    yield Mutant(stage, "fractions rounded", _PRINTER, decimal, "decimal = repr(round(p / q, 4))", "van_der_pol", "rk4")
    power = "sympy.Pow(base, -exponent, evaluate=False)"
    yield Mutant(
        stage,
        "negative powers off by one",
        _PRINTER,
        power,
        power.replace("-exponent", "1 - exponent"),
        "orbital_transfer",
    )
    parameter = (
        'codes |= {symbol: f"parameters[{i}]" for i, symbol in enumerate(parameters(program))}\n    codes[program'
    )
    yield Mutant(
        stage,
        "kernels read other parameters",
        _KERNELS,
        parameter,
        parameter.replace("{i}", "{max(0, i - 1)}"),
        "orbital_transfer",
    )
    yield Mutant(
        stage,
        "h read for t",
        _KERNELS,
        'codes[program.model.time] = "t"',
        'codes[program.model.time] = "h"',
        "low_thrust",
    )
    sides = '(("lower", unknown.lower), ("upper", unknown.upper))'
    yield Mutant(
        stage,
        "lower and upper bounds exchanged",
        _BOUNDS,
        sides,
        '(("upper", unknown.lower), ("lower", unknown.upper))',
        "double_integrator",
    )
    ends = 'ends = (("0", program.start), ("-1", program.end))\n    values'
    yield Mutant(
        stage,
        "values of both ends exchanged",
        _BOUNDS,
        ends,
        ends.replace('"0"', '"x"').replace('"-1"', '"0"').replace('"x"', '"-1"'),
        "linear_pendulum",
    )
    length = "is_free, code, clock = program.scaled_time, scalar_code(program.model.duration), program.inner.clock"
    yield Mutant(
        stage,
        "the default duration doubled",
        _LAYOUT,
        length,
        length.replace("scalar_code(program", "scalar_code(2 * program"),
        "orbital_transfer",
    )
    simulated = "duration=scalar_code(model.duration)"
    yield Mutant(
        stage,
        "the duration of a simulation doubled",
        "emit/lower/simulate.py",
        simulated,
        simulated.replace("(model", "(2 * model"),
        "pendulum",
    )
    first = "Line(unknown.name, scalar_code(value)) for unknown, value in"
    yield Mutant(
        stage,
        "the start of a simulation reversed",
        "emit/lower/simulate.py",
        first,
        first.replace("(value)", "(-value)"),
        "pendulum",
    )
    boundary = "values=tuple(Line(v.symbol.name, boundary_code(v.value)"
    yield Mutant(
        stage,
        "boundary values reversed",
        "emit/lower/control/__init__.py",
        boundary,
        boundary.replace("(v.value", "(-v.value"),
        "orbital_transfer",
    )
    record = '"parameters": {p.name: value for p, value in zip(model.parameters, model.defaults, strict=True)},'
    yield Mutant(
        stage,
        "defaults of the record exchanged",
        "emit/lower/module.py",
        record,
        record.replace("model.defaults", "model.defaults[::-1]"),
        "orbital_transfer",
    )
    tabled = "repr(number) for number in table.numbers"
    yield Mutant(
        stage,
        "numbers of tables doubled",
        "emit/lower/kernels.py",
        tabled,
        tabled.replace("repr(n", "repr(2 * n"),
        "published/time_to_climb",
    )


def _layout() -> Iterator[Mutant]:
    stage = Stage.LAYOUT
    flags = "[u.multiplier for u in (*program.node, *inside)]"
    yield Mutant(
        stage, "multipliers and unknowns exchanged", _LAYOUT, flags, flags.replace("[u.", "[not u."), "linear_pendulum"
    )
    pinned = 'Line("START_PINNED", integers(_pinned(program.start))'
    yield Mutant(
        stage,
        "the prescribed unknowns of the other end",
        _LAYOUT,
        pinned,
        pinned.replace("program.start", "program.end"),
        "goddard_rocket",
    )
    at_end = 'Line("END_PINNED", integers(_pinned(program.end))'
    yield Mutant(
        stage,
        "an end value that nothing fixes",
        _LAYOUT,
        at_end,
        at_end.replace("_pinned(program.end)", "_pinned(program.end)[:-1]"),
        "linear_pendulum",
    )
    rows = 'Line("HESSIAN_ROWS", integers([r for r, _, _ in derivatives.element.hessian]))'
    yield Mutant(
        stage,
        "rows and columns of the Hessian exchanged",
        _LAYOUT,
        rows,
        rows.replace("[r for r, _, _", "[r for _, r, _"),
        "linear_pendulum",
    )
    stride = "stride, condensed, stages = len(program.node) + len(inside)"
    yield Mutant(stage, "one unknown too many", _LAYOUT, stride, f"{stride} + 1", "linear_pendulum")
    linking = 'Line("LINKING", str(first)'
    yield Mutant(
        stage,
        "linking variables in the place of parameters",
        _LAYOUT,
        linking,
        linking.replace("first", "first - 1"),
        "double_integrator",
    )
    only = 'integers(program.only_at_ends), "unknowns that inner'
    yield Mutant(
        stage,
        "unknowns of the ends at all nodes",
        _LAYOUT,
        only,
        only.replace("program.only_at_ends", "()"),
        "low_thrust",
    )
    motion = 'f"np.arange({n}, {2 * n})", "multipliers'
    yield Mutant(
        stage,
        "momenta of other equations",
        _LAYOUT,
        motion,
        motion.replace("{n}, {2 * n}", "0, {n}"),
        "linear_pendulum",
    )
    slacks = "first = len(program.node) + len(program.interval) + len(program.controls)\n        slacks"
    yield Mutant(
        stage,
        "slacks in the place of controls",
        _LAYOUT,
        slacks,
        slacks.replace(" + len(program.controls)", ""),
        "low_thrust",
    )
    positions = 'SolutionText(f"nodes[:, :, :{n}]"'
    yield Mutant(
        stage,
        "multipliers reported for positions",
        _LAYOUT,
        positions,
        positions.replace(":{n}]", "1:{n + 1}]"),
        "linear_pendulum",
    )


MUTANTS = tuple(
    mutant for of_stage in (_reading, _transcription, _differentiation, _emission, _layout) for mutant in of_stage()
)


class Replaced(SourceFileLoader):
    """The loader of a source file in which a defect is planted."""

    mutant: Mutant

    def get_code(self, fullname: str):
        """Compile the text with the defect; nothing is kept on disk."""
        text = Path(self.path).read_text(encoding="utf-8")
        assert self.mutant.old in text, f"{self.mutant.file} has no {self.mutant.old!r}"
        return self.source_to_code(text.replace(self.mutant.old, self.mutant.new, 1).encode(), self.path)


class Planted(MetaPathFinder):
    """The finder that gives one module of the package its own loader."""

    def __init__(self, mutant: Mutant) -> None:
        self.mutant = mutant
        self.name = "codegen." + mutant.file.removesuffix(".py").removesuffix("/__init__").replace("/", ".")

    def find_spec(self, fullname: str, path=None, target=None) -> ModuleSpec | None:
        """Return the specification of the module with the defect, None for all other modules."""
        if fullname != self.name:
            return None
        spec = PathFinder.find_spec(fullname, path)
        assert spec is not None
        assert spec.origin is not None
        spec.loader = Replaced(fullname, spec.origin)
        spec.loader.mutant = self.mutant
        return spec


def outcome_of(mutant: Mutant, only: tuple[str, ...] = (), seconds: float = 15.0) -> Outcome:
    """Import the package with a defect, and check the module of its problem up to the first check that finds it.

    By default these are all checks in the order of a report, each for at most `seconds`.
    """
    begin = time.perf_counter()
    assert not any(name.startswith("codegen") for name in sys.modules), "the package is imported already"
    planted = Planted(mutant)
    sys.meta_path.insert(0, planted)
    from interpreted import all_uncompiled

    from codegen.emit.naming import chosen
    from codegen.errors import CodegenError
    from codegen.evidence import checks
    from codegen.problem.sources import settings_of
    from codegen.runtime.kkt.specialised import compiled_system
    from codegen.solving.compiler import generate

    compiled_system(None)  # the first process compiles this code, which no limit of a check may interrupt

    with tempfile.TemporaryDirectory() as folder:
        path = ROOT / "problems" / f"{mutant.problem}.py"
        if mutant.problem in TEXTS:
            path = Path(folder) / f"{mutant.problem}.py"
            path.write_text(TEXTS[mutant.problem], encoding="utf-8")
        choices, module = chosen(mutant.scheme, mutant.method), Path(folder) / "planted.py"
        try:
            module.write_text(generate(path, {}, choices), encoding="utf-8")
            if not isinstance(sys.modules[planted.name].__loader__, Replaced):
                raise RuntimeError(f"the defect in {mutant.file} was not planted")
            with all_uncompiled():
                context = checks.context_of(path, settings_of(path, {}), choices, module)
                for name in only or checks.CHECKS:
                    failed = (finding for finding in checks.apply(name, context, seconds) if not finding.passed)
                    if finding := next(failed, None):
                        text = f"{finding.subject}: {finding.detail}"[:300]
                        return Outcome(name, text, time.perf_counter() - begin)
        except (CodegenError, AssertionError, ValueError, TypeError, IndexError, KeyError) as error:
            # The build itself refuses the module, or cannot be completed.
            return Outcome("build", f"{type(error).__name__}: {error}"[:300], time.perf_counter() - begin)
    return Outcome("", "", time.perf_counter() - begin)


def outcomes(numbers: Sequence[int], only: tuple[str, ...] = ()) -> list[Outcome]:
    """Return the outcomes of defects, by their numbers in MUTANTS, from one new process for each.

    A process that imports other packages, and none of this one, is copied for each defect.
    """
    command = [sys.executable, str(Path(__file__)), "--check", *only, "--", *map(str, numbers)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    return [Outcome(**row) for row in json.loads(done.stdout.splitlines()[-1])]


def _outcome(task: tuple[int, tuple[str, ...]]) -> dict[str, object]:
    return asdict(outcome_of(MUTANTS[task[0]], task[1]))


def main() -> None:
    """Print the outcomes of the defects whose numbers are arguments, as JSON."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--check", nargs="*", default=[], help="names of checks; all by default")
    parser.add_argument("numbers", nargs="+", type=int)
    arguments = parser.parse_args()
    for name in ("numba", "scipy.special", "sympy"):
        importlib.import_module(name)
    tasks = [(number, tuple(arguments.check)) for number in arguments.numbers]
    with multiprocessing.get_context("fork").Pool(1, maxtasksperchild=1) as pool:
        print(json.dumps(pool.map(_outcome, tasks, chunksize=1)))


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parent))
    main()
