"""Malformed tables: what each file of numbers gets wrong, and what the message must name, the line included."""

from __future__ import annotations

from codegen.errors import CodegenError, ExpressionError, SymbolError, TableError
from malformed.templates import Malformed, file_text, optimal

_CURVE = "q,f\n0,0\n1,1\n2,3\n3,2\n"
_GRID = "q,v,f\n" + "".join(f"{q},{v},{q * v}\n" for q in range(4) for v in range(5))


def _curve(
    id_: str,
    fragment: str,
    text: str = _CURVE,
    call: str = 'Table("t.csv", "q", "f")',
    error: type[CodegenError] = TableError,
) -> Malformed:
    """A control of an oscillator whose force has a table of one input, in the file t.csv."""
    declare = f"from codegen import Table\ntable = {call}"
    return Malformed(f"table-{id_}", optimal(declare, force="{q: f + table(q)}"), error, fragment, (("t.csv", text),))


def _grid(id_: str, fragment: str, text: str) -> Malformed:
    """The same with a table of two inputs."""
    declare = 'from codegen import Table\ntable = Table("t.csv", ("q", "v"), "f")'
    force = "{q: f + table(q, dq)}"
    return Malformed(f"grid-{id_}", optimal(declare, force=force), TableError, fragment, (("t.csv", text),))


def _used(id_: str, fragment: str, error: type[CodegenError], **changes: str) -> Malformed:
    """A sound table, named table, that is used where it cannot be."""
    declare = 'from codegen import Table\ntable = Table("t.csv", "q", "f")'
    return Malformed(f"table-{id_}", optimal(declare, **changes), error, fragment, (("t.csv", _CURVE),))


_FILES = (
    _curve("missing-file", "other.csv: no such file", call='Table("other.csv", "q", "f")'),
    _curve("folder", "is a directory", call='Table(".", "q", "f")'),
    _curve("empty", "t.csv is empty", ""),
    _curve("comments-alone", "t.csv is empty", "# nothing\n\n"),
    _curve("header-alone", "has 0 values of q", "q,f\n"),
    _curve("too-few-rows", "has 3 values of q; a cubic table needs 4", "q,f\n0,0\n1,1\n2,3\n"),
    _curve("binary", "cannot be read", "q,f\n\udcff\n"),
    _curve("missing-column", "t.csv:1: there is no column 'g'; name one of q, f", call='Table("t.csv", "q", "g")'),
    _curve("semicolons", "t.csv:1: ';' separates the columns; separate columns by commas", "q;f\n0;0\n1;1\n"),
    _curve("column-twice", "t.csv:1: two columns are called 'f'", "q,f,f\n0,1,2\n"),
    _curve("unsorted", "t.csv:4: q is 1 after 2", "q,f\n0,0\n2,1\n1,3\n3,2\n"),
    _curve("duplicate", "t.csv:5: q is 1 twice", "q,f\n0,0\n# here\n1,1\n1,3\n3,2\n"),
    _curve("nan", "t.csv:3: f is 'nan'", "q,f\n0,0\n1,nan\n2,3\n3,2\n"),
    _curve("infinite", "t.csv:4: q is 'inf'", "q,f\n0,0\n1,1\ninf,3\n"),
    _curve("word", "t.csv:2: f is 'none'", "q,f\n0,none\n"),
    _curve("blank", "t.csv:3: f is ''", "q,f\n0,0\n1,\n"),
    _curve("ragged-row", "t.csv:3: 3 values for 2 columns", "q,f\n0,0\n1,1,1\n"),
    _grid("duplicate", "t.csv:22: q 0 and v 0 stand in line 2 already", _GRID + "0,0,1\n"),
    _grid("missing-pair", "t.csv:7: there is no row with q 1 and v 4", _GRID.replace("1,4,4\n", "")),
    _grid("unequal-axis", "there is no row with", _GRID + "0,7,0\n"),
    _grid("too-few", "has 3 values of q", "".join(_GRID.splitlines(keepends=True)[:16])),
    _grid("nan", "t.csv:21: f is 'NaN'", _GRID.replace("3,4,12", "3,4,NaN")),
)
_ARGUMENTS = (
    _curve("kind", "kind of table f is 'quintic'; use one of cubic", call='Table("t.csv", "q", "f", kind="quintic")'),
    _curve("outside", "outside of table f is 'ignore'", call='Table("t.csv", "q", "f", outside="ignore")'),
    _curve("three-inputs", "name one or two columns", call='Table("t.csv", ("q", "v", "w"), "f")'),
    _curve("input-twice", "a column twice", call='Table("t.csv", ("q", "q"), "f")'),
    _curve("input-number", "3 of table 'f' is no name", call='Table("t.csv", (3,), "f")'),
    _curve("output-number", "is no name of a column", call='Table("t.csv", "q", 3)'),
    _curve("file-number", "the file of a table is 3", call='Table(3, "q", "f")'),
    _curve("name", "a table is called 'my f'", call='Table("t.csv", "q", "f", name="my f")'),
    _curve("monotone-grid", "of two inputs is monotone", call='Table("t.csv", ("q", "f"), "g", kind="monotone")'),
    _curve("many-arguments", "table f is called with 2 arguments", call='Table("t.csv", "q", "f")(q, dq)'),
    _curve("argument-text", "q of table f is 'q'", call='Table("t.csv", "q", "f")("q")', error=ExpressionError),
    _used("in-duration", "duration reads table f", ExpressionError, duration="2 + table(parameter('k', 1))"),
    _used("in-bounds", "reads table f", ExpressionError, bounds="{f: (-table(parameter('k', 1)), 1)}"),
    _used("uncalled", "force of q is a Table; call it, as in f(q)", ExpressionError, force="{q: table}"),
    _curve("of-steps", "reads table f of steps", call='Table("t.csv", "q", "f", kind="steps")', error=ExpressionError),
    _used("of-undeclared", "was never declared", SymbolError, force='{q: f + table(Symbol("z"))}'),
)


def _start(
    id_: str, fragment: str, text: str = "t,q,f\n0,0,1\n1,1,1\n", call: str = 'Trajectory("t.csv")'
) -> Malformed:
    """A control of an oscillator that starts from the trajectory in t.csv."""
    declare = "from codegen import Trajectory"
    return Malformed(f"start-{id_}", optimal(declare, guess=call), TableError, fragment, (("t.csv", text),))


_STARTS = (
    _start("missing-file", "nothing.csv: no such file", call='Trajectory("nothing.csv")'),
    _start("missing-time", "there is no column 'time'", call='Trajectory("t.csv", time="time")'),
    _start("time-alone", "has no column beside 't'", "t\n0\n1\n"),
    _start("unknown-column", "called g; call it like one of q, f, or choose columns", "t,g\n0,1\n1,2\n"),
    _start("missing-column", "there is no column 'dq'", call='Trajectory("t.csv", columns=["q", "dq"])'),
    _start("columns-text", "columns of t.csv are 'q'", call='Trajectory("t.csv", columns="q")'),
    _start("unsorted", "t.csv:3: t is 0 after 1", "t,q\n1,0\n0,1\n"),
    _start("ragged", "t.csv:3: 1 values for 2 columns", "t,q\n0,0\n1\n"),
    _start("kind", "kind of table trajectory is 'spline'", call='Trajectory("t.csv", kind="spline")'),
)

_OF_PARTICLES = """from codegen import Pairwise, Table, particles
i, j = particles("x y", "px py")
table = Table("t.csv", "q", "f")
pair = table((i.q[0] - j.q[0]) ** 2)
system = Pairwise((i, j), self_term=i.p[0] ** 2 + i.p[1] ** 2, pair_term=pair)
start = {i.q[0]: (0, 1), i.q[1]: (0, 1), i.p[0]: (0, 0), i.p[1]: (0, 0)}
return Simulate(hamiltonian=system, duration=1, start=start)"""
_PARTICLES = (
    Malformed(
        "table-of-particles", file_text(_OF_PARTICLES), ExpressionError, "pair_term reads table f", (("t.csv", _CURVE),)
    ),
)

MALFORMED_TABLES: tuple[Malformed, ...] = (*_FILES, *_ARGUMENTS, *_PARTICLES, *_STARTS)
