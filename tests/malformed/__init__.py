"""Malformed problem files: what each gets wrong, the error it must cause, and what the message must name."""

from __future__ import annotations

from codegen.errors import BoundaryError, DegenerateError, ExpressionError, ProblemFileError, SymbolError
from malformed.conditions import MALFORMED_CONDITIONS
from malformed.delays import MALFORMED_DELAYS
from malformed.inner_times import MALFORMED_INNER_TIMES
from malformed.measurements import MALFORMED_MEASUREMENTS
from malformed.phases import MALFORMED_PHASES
from malformed.tables import MALFORMED_TABLES
from malformed.templates import Malformed, declaring, file_text, optimal, simulation

_TWO = '(a, b), (da, db) = coordinates("a b")\n'
_CANONICAL = 'q, p = canonical_pair("q", "p")\n'

_FILES = [
    Malformed("empty", "", ProblemFileError, "no docstring"),
    Malformed("no-docstring", "def problem():\n    return None\n", ProblemFileError, "no docstring"),
    Malformed("blank-docstring", '"""  \n"""\ndef problem(): ...\n', ProblemFileError, "no docstring"),
    Malformed("no-problem", '"""Nothing."""\n', ProblemFileError, "problem()"),
    Malformed("problem-not-callable", '"""A number."""\nproblem = 3\n', ProblemFileError, "problem()"),
    Malformed("asynchronous", '"""Async."""\nasync def problem(): ...\n', ProblemFileError, "asynchronous"),
    Malformed("syntax-error", '"""Typo."""\n\ndef problem(:\n', ProblemFileError, "broken.py:3: SyntaxError"),
    Malformed("indentation", '"""Typo."""\ndef problem():\nreturn\n', ProblemFileError, "broken.py:3: Indentation"),
    Malformed("null-byte", '"""Null."""\n\0\n', ProblemFileError, "broken.py"),
    Malformed("too-deep", '"""Deep."""\nx = ' + "(" * 5000 + ")" * 5000 + "\n", ProblemFileError, "broken.py"),
    Malformed("missing-import", '"""I."""\nimport no_such_package\n', ProblemFileError, "broken.py:2: ModuleNotFound"),
    Malformed("raises-at-import", '"""R."""\n1 / 0\n', ProblemFileError, "broken.py:2: ZeroDivisionError"),
    Malformed("exits-at-import", '"""E."""\nimport sys\nsys.exit(3)\n', ProblemFileError, "broken.py:3: SystemExit: 3"),
    Malformed("raises-inside", file_text("x = 1\nraise KeyError('mass')"), ProblemFileError, ":9: KeyError: 'mass'"),
    Malformed("raises-lines", file_text("raise ValueError('one\\ntwo\\r\\nthree')"), ProblemFileError, "one two three"),
    Malformed("raises-silently", file_text("raise ValueError"), ProblemFileError, ":8: ValueError;"),
    Malformed("exits-inside", file_text("raise SystemExit"), ProblemFileError, ":8: SystemExit"),
    Malformed("endless-recursion", file_text("return problem()"), ProblemFileError, "RecursionError"),
    Malformed("assertion", file_text("assert False, 'no mass'"), ProblemFileError, "AssertionError: no mass"),
    Malformed("required-argument", file_text("return None", "mass"), ProblemFileError, "requires mass"),
    Malformed("positional-argument", file_text("return None", "mass=1, /"), ProblemFileError, "mass"),
    Malformed("star-argument", file_text("return None", "*masses"), ProblemFileError, "*masses"),
    Malformed("star-star-argument", file_text("return None", "**options"), ProblemFileError, "**options"),
    Malformed("bad-annotation", file_text("return None", "a: 'Mass' = 1"), ProblemFileError, "Mass"),
    Malformed("returns-nothing", file_text("pass"), ProblemFileError, "NoneType"),
    Malformed("returns-dict", file_text("return {}"), ProblemFileError, "dict"),
    Malformed("returns-class", file_text("return Simulate"), ProblemFileError, "type"),
    Malformed("generator", file_text("yield 1"), ProblemFileError, "generator"),
    Malformed("missing-keyword", optimal(duration=""), ProblemFileError, "'duration'"),
    Malformed("unknown-keyword", simulation(lagrange="q"), ProblemFileError, "'lagrange'"),
    Malformed("keyword-misspelt", simulation(lagrangan="q"), ProblemFileError, "perhaps it is lagrangian"),
    Malformed("keyword-of-others", simulation(final_time="2"), ProblemFileError, "perhaps it is duration"),
    Malformed("time-not-called", declaring("q * time"), ProblemFileError, "t = time()"),
    Malformed("unpacking", file_text('(a, b), (da,) = coordinates("a b")'), ProblemFileError, "unpack"),
    Malformed("function-of-math", declaring("import math; math.sin(q)"), ProblemFileError, "from sympy"),
    Malformed("function-of-numpy", declaring("import numpy; numpy.sin(q)"), ExpressionError, "from sympy"),
    Malformed("function-of-numpy-of-sum", declaring("import numpy; numpy.sin(q + 1)"), ProblemFileError, "from sympy"),
    Malformed("chain-of-comparisons", optimal(path="[-1 <= f <= 1]"), ProblemFileError, "two inequalities"),
    Malformed("free-parameter-alone", declaring('free_parameter("T")'), ProblemFileError, 'free_parameter("T", 3)'),
    Malformed("tuple-as-control", declaring('controls("w")**2'), ProblemFileError, "unpack"),
    Malformed("tuple-as-parameter", declaring("q * parameters(k=1)"), ProblemFileError, "unpack"),
    Malformed(
        "matrix-as-key", declaring("from sympy import Matrix; {Matrix([q]): 1}"), ProblemFileError, "ImmutableMatrix"
    ),
    Malformed("truth-of-symbol", declaring("if q > 0: pass"), ProblemFileError, "truth value"),
]

_NAMES = [
    Malformed("name-with-digit", declaring('parameter("1m", 1)'), SymbolError, "'1m'"),
    Malformed("name-empty", declaring('parameter("", 1)'), SymbolError, "''"),
    Malformed("name-with-hyphen", declaring('coordinates("a-b")'), SymbolError, "'a-b'"),
    Malformed("name-no-text", declaring("parameter(3, 1)"), SymbolError, "3"),
    Malformed("names-none", declaring('coordinates(" ")'), SymbolError, "' '"),
    Malformed("names-endless", declaring('coordinates("a1:")'), SymbolError, "'a1:'"),
    Malformed("names-unequal", declaring('coordinates("a b", "va")'), SymbolError, "a b"),
    Malformed("declared-line", declaring('\nparameter("1m", 1)'), SymbolError, "broken.py:10: "),
    Malformed("duplicate", simulation('k = parameter("q", 1)', lagrangian="dq**2 - k*q**2"), SymbolError, "called q"),
    Malformed("duplicate-velocity", simulation('k = parameter("dq", 1)', duration="k"), SymbolError, "called dq"),
    Malformed("duplicate-declaration", declaring('q, dq = coordinate("q")'), SymbolError, "called q"),
    Malformed("two-times", simulation('t, s = time(), time("s")', force="{q: t + s}"), SymbolError, "t, s"),
    Malformed("undeclared", simulation(lagrangian='dq**2 - Symbol("k")*q**2'), SymbolError, "k in lagrangian"),
    Malformed("undeclared-in-cost", optimal(cost='f**2 + Symbol("w")'), SymbolError, "w in cost"),
    Malformed("symbol-of-sympy", optimal(cost='f**2 + Symbol("q")'), SymbolError, "not the declared q; use the symbol"),
    Malformed("undeclared-control", optimal(cost='Symbol("g")**2'), SymbolError, "g in cost"),
    Malformed("undeclared-in-force", simulation(force='{q: -Symbol("c")*dq}'), SymbolError, "c in force of q"),
    Malformed("undeclared-in-duration", simulation(duration='Symbol("T")'), SymbolError, "T in duration"),
    Malformed("undeclared-key", simulation(start='{Symbol("q"): 0, dq: 0}'), SymbolError, "start has the key q"),
    Malformed("tuple-key", simulation(start="{(q,): 0, dq: 0}"), SymbolError, "key (q,), which is a tuple"),
    Malformed("text-as-key", simulation(start='{"q": 0, "dq": 1}'), SymbolError, "'q'"),
    Malformed("control-without-force", optimal('g = control("g")', cost="f**2 + g**2"), SymbolError, "control g"),
    Malformed("control-in-lagrangian", optimal(lagrangian="dq**2/2 + f*q"), SymbolError, "control f"),
    Malformed("control-in-simulation", simulation('g = control("g")', force="{q: g}"), SymbolError, "control g"),
    Malformed("force-on-velocity", simulation(force="{dq: -q}"), SymbolError, "dq"),
    Malformed("force-on-control", optimal(force="{q: f, f: 1}"), SymbolError, "acts on f"),
    Malformed(
        "guess-of-free-parameter",
        optimal('T = free_parameter("T", 1)', duration="T", guess="{T: 2}"),
        SymbolError,
        'free_parameter("T", 3)',
    ),
    Malformed("guess-array", optimal("import numpy", guess="{q: numpy.ones(5)}"), ExpressionError, "Trajectory("),
    Malformed("guess-of-velocity", optimal(guess="{dq: 1}"), SymbolError, "dq"),
    Malformed(
        "momentum-in-lagrangian",
        file_text(_CANONICAL + "return Simulate(lagrangian=p**2/2 - q**2/2, duration=1, start={q: 0, p: 1})"),
        SymbolError,
        "p is a momentum",
    ),
    Malformed("velocity-in-hamiltonian", simulation(lagrangian="", hamiltonian="dq**2/2 + q"), SymbolError, "velocity"),
]

_NUMBERS = [
    Malformed("parameter-infinite", declaring('parameter("k", float("inf"))'), SymbolError, "parameter k is inf"),
    Malformed("parameter-nan", declaring("parameters(k=nan)"), SymbolError, "parameter k is nan"),
    Malformed("parameter-complex", declaring("parameters(k=1j)"), SymbolError, "parameter k is 1j"),
    Malformed("parameter-text", declaring('parameters(k="5")'), SymbolError, "parameter k is '5'"),
    Malformed("parameter-list", declaring("parameters(k=[1])"), SymbolError, "parameter k is [1]"),
    Malformed("parameter-ragged", declaring("parameters(k=[1, [2]])"), SymbolError, "parameter k is [1, [2]]"),
    Malformed("parameter-symbol", declaring("parameters(k=q)"), SymbolError, "parameter k is q"),
    Malformed("parameter-none", declaring("parameters(k=None)"), SymbolError, "parameter k is None"),
    Malformed("parameter-truth", declaring("parameters(k=True)"), SymbolError, "parameter k is True"),
    Malformed("parameter-huge", declaring("parameters(k=10**400)"), SymbolError, "parameter k"),
    Malformed("nan", simulation(start="{q: nan, dq: 0}"), ExpressionError, "start of q contains nan"),
    Malformed("infinite", simulation(duration='float("inf")'), ExpressionError, "duration contains oo"),
    Malformed("zoo", simulation(lagrangian="dq**2/2 + q/Integer(0)"), ExpressionError, "lagrangian contains zoo"),
    Malformed("huge", simulation(lagrangian="dq**2/2 + 10**400*q"), ExpressionError, "lagrangian contains 1.0000"),
    Malformed("complex", simulation(lagrangian="dq**2/2 + I*q"), ExpressionError, "lagrangian is complex"),
    Malformed("complex-number", simulation(start="{q: 1j, dq: 0}"), ExpressionError, "start of q is complex"),
    Malformed("complex-root", simulation(start="{q: (-1)**Rational(1, 3), dq: 0}"), ExpressionError, "start of q"),
    Malformed("nowhere-real", simulation(lagrangian="dq**2*sqrt(-1 - q**2)"), ExpressionError, "lagrangian has no"),
    Malformed("cost-nowhere-real", optimal(cost="f**2 + log(-1 - q**2)"), ExpressionError, "cost has no"),
    Malformed(
        "division-by-parameter",
        simulation("k = parameter('k', 0)", lagrangian="dq**2 - q**2/k"),
        ExpressionError,
        "lagrangian has no",
    ),
    Malformed("start-divides", simulation("k = parameter('k', 0)", start="{q: 1/k, dq: 0}"), ExpressionError, "1/k"),
    Malformed("start-root", simulation("k = parameter('k', -1)", start="{q: sqrt(k), dq: 0}"), ExpressionError, "k"),
    Malformed("end-divides", optimal("k = parameter('k', 0)", end="{q: 1/k}"), ExpressionError, "end of q is 1/k"),
    Malformed("duration-negative", simulation(duration="-1"), ExpressionError, "duration is -1"),
    Malformed("duration-zero", simulation(duration="0"), ExpressionError, "duration is 0"),
    Malformed("duration-none", simulation(duration="None"), ExpressionError, "duration is None"),
    Malformed("duration-of-state", simulation(duration="q"), ExpressionError, "duration depends on q"),
    Malformed("duration-of-parameter", simulation("k = parameter('k', -2)", duration="k"), ExpressionError, "is -2"),
    Malformed("steps-zero", simulation(steps="0"), ExpressionError, "steps is 0"),
    Malformed("steps-negative", simulation(steps="-5"), ExpressionError, "steps is -5"),
    Malformed("steps-fractional", simulation(steps="2.5"), ExpressionError, "steps is 2.5"),
    Malformed("steps-truth", simulation(steps="True"), ExpressionError, "steps is True"),
    Malformed("steps-text", simulation(steps='"10"'), ExpressionError, "steps is '10'"),
]

_EXPRESSIONS = [
    Malformed("both-forms", simulation(hamiltonian="q**2"), ExpressionError, "exactly one"),
    Malformed("neither-form", simulation(lagrangian=""), ExpressionError, "exactly one"),
    Malformed("undefined-function", simulation(lagrangian='dq**2/2 - Function("V")(q)'), ExpressionError, "uses V"),
    Malformed("zeta", simulation(lagrangian="dq**2/2 - zeta(q)"), ExpressionError, "uses zeta"),
    Malformed(
        "integral", simulation(lagrangian="dq**2/2 - Integral(exp(sin(q)), q)"), ExpressionError, "no closed form"
    ),
    Malformed("matrix", simulation(lagrangian="Matrix([[dq**2/2]])"), ExpressionError, "is a matrix"),
    Malformed("array", simulation(lagrangian="Array([dq**2/2])"), ExpressionError, "DenseNDimArray"),
    Malformed("text", simulation(lagrangian='"dq**2/2"'), ExpressionError, "'dq**2/2'"),
    Malformed("truth", simulation(lagrangian="True"), ExpressionError, "lagrangian is True"),
    Malformed("equation", simulation(lagrangian="Eq(dq, q)"), ExpressionError, "Equality"),
    Malformed("function", simulation(lagrangian="sin"), ExpressionError, "lagrangian is a"),
    Malformed("cost-zero", optimal(cost="0 * f"), ExpressionError, "the cost is zero, whatever moves"),
    Malformed("cost-rate", optimal(cost="f.diff(time())**2"), ExpressionError, "declare the rate as the control"),
    Malformed(
        "cost-beside-rate", optimal(cost="f**2 + 100*diff(f, time())**2"), ExpressionError, "dynamics={f: df, ...}"
    ),
    Malformed("rate-of-coordinate", optimal(force="{q: f - q.diff(time())}"), ExpressionError, "its velocity dq"),
    Malformed("rate-by-other-symbol", optimal(cost='f**2 + Derivative(f, Symbol("t"))'), ExpressionError, "is zero"),
    Malformed("end-pair", optimal(end="{q: (1, 2)}"), ExpressionError, "limits as in end_conditions=[q >= ..."),
    Malformed("bounds-expression", optimal(bounds="{q * f: (0, 1)}"), SymbolError, "write path=[f*q <= ...]"),
    Malformed("cost-none", optimal(cost="None"), ExpressionError, "cost is None"),
    Malformed("cost-tuple", optimal(cost="(f**2,)"), ExpressionError, "cost is a Tuple"),
    Malformed("force-not-mapping", simulation(force="[0]"), ExpressionError, "force is a list"),
    Malformed("force-none", simulation(force="None"), ExpressionError, "force is a NoneType"),
    Malformed("force-text", simulation(force='{q: "f"}'), ExpressionError, "force of q is 'f'"),
    Malformed("start-not-mapping", simulation(start="[0, 1]"), ExpressionError, "start is a list"),
    Malformed("start-list", simulation(start="{q: [0], dq: 0}"), ExpressionError, "start of q is a list"),
    Malformed("start-text", simulation(start='{q: "0", dq: 0}'), ExpressionError, "start of q is '0'"),
    Malformed("start-of-state", simulation(start="{q: dq, dq: 0}"), ExpressionError, "start of q depends on dq"),
    Malformed("end-of-time", optimal("t = time()", end="{q: t}"), ExpressionError, "end of q depends on t"),
    Malformed("end-of-control", optimal(end="{q: f}"), ExpressionError, "end of q depends on f"),
    Malformed("guess-of-state", optimal(guess="{q: dq}"), ExpressionError, "guess of q depends on dq"),
    Malformed(
        "no-coordinate",
        file_text("return Simulate(lagrangian=1, duration=1, start={})"),
        ExpressionError,
        "no coordinate",
    ),
]

_STRUCTURE = [
    Malformed("no-kinetic-energy", simulation(lagrangian="-q**2"), DegenerateError, "degenerate in dq"),
    Malformed("linear-in-velocity", simulation(lagrangian="q*dq"), DegenerateError, "degenerate in dq"),
    Malformed(
        "massless", simulation("k = parameter('k', 0)", lagrangian="k*dq**2 - q"), DegenerateError, "degenerate in dq"
    ),
    Malformed("kinked", simulation(lagrangian="Abs(dq) - q**2"), DegenerateError, "degenerate in dq"),
    Malformed(
        "one-massless-coordinate",
        file_text(_TWO + "return Simulate(lagrangian=da**2/2 - a*b, duration=1, start={a: 0, b: 0, da: 0, db: 0})"),
        DegenerateError,
        "degenerate in db",
    ),
    Malformed(
        "coupled-singular",
        file_text(
            _TWO + "return Simulate(lagrangian=(sin(a)*da + db)**2/2, duration=1, start={a: 1, b: 0, da: 0, db: 0})"
        ),
        DegenerateError,
        "degenerate in da db",
    ),
    Malformed("start-lacks-velocity", simulation(start="{q: 0}"), BoundaryError, "start lacks dq"),
    Malformed("start-lacks-position", simulation(start="{dq: 0}"), BoundaryError, "start lacks q"),
    Malformed("start-empty", simulation(start="{}"), BoundaryError, "start lacks q, dq"),
    Malformed("end-fixes-control", optimal(end="{q: 1, f: 0}"), BoundaryError, "end fixes f"),
    Malformed("start-fixes-parameter", optimal("k = parameter('k', 1)", start="{k: 1}"), BoundaryError, "fixes k"),
    Malformed(
        "start-lacks-momentum",
        file_text(_CANONICAL + "return Simulate(hamiltonian=p**2/2, duration=1, start={q: 0})"),
        BoundaryError,
        "start lacks p",
    ),
]

MALFORMED: tuple[Malformed, ...] = (
    *_FILES,
    *_NAMES,
    *_NUMBERS,
    *_EXPRESSIONS,
    *_STRUCTURE,
    *MALFORMED_CONDITIONS,
    *MALFORMED_INNER_TIMES,
    *MALFORMED_PHASES,
    *MALFORMED_TABLES,
    *MALFORMED_MEASUREMENTS,
    *MALFORMED_DELAYS,
)
"""All of them; a file is to be written as `broken.py`, which some fragments name."""
