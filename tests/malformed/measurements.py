"""Malformed measurements: what each file or argument gets wrong, and what the message must name, the line included."""

from __future__ import annotations

from codegen.errors import CodegenError, ExpressionError, SymbolError, TableError
from malformed.templates import Malformed, file_text, optimal

_FILE = "t,z,s\n0,0,0.1\n0.25,0.3,0.1\n0.5,,0.1\n1,0.9,0.1\n"


def _measured(
    id_: str,
    fragment: str,
    text: str = _FILE,
    call: str = 'Measurements("m.csv", values={q: "z"})',
    error: type[CodegenError] = TableError,
    **changes: str,
) -> Malformed:
    """A control of an oscillator that was measured, by the file m.csv."""
    declare = "from codegen import Measurements, each_body"
    changes = {"observations": call, **changes}
    return Malformed(f"measurements-{id_}", optimal(declare, **changes), error, fragment, (("m.csv", text),))


def _called(id_: str, fragment: str, arguments: str, error: type[CodegenError] = TableError) -> Malformed:
    """A sound file of measurements, with arguments that are none."""
    return _measured(id_, fragment, call=f'Measurements("m.csv", {arguments})', error=error)


_FILES = (
    _measured("missing-file", "n.csv: no such file", call='Measurements("n.csv", values={q: "z"})'),
    _measured("folder", "is a directory", call='Measurements(".", values={q: "z"})'),
    _measured("header-alone", "column z holds no value", "t,z\n"),
    _measured("no-values", "column z holds no value", "t,z\n0,\n1,\n"),
    _measured("missing-column", "m.csv:1: there is no column 'y'", call='Measurements("m.csv", values={q: "y"})'),
    _measured(
        "missing-time", "m.csv:1: there is no column 'time'", call='Measurements("m.csv", values={q: "z"}, time="time")'
    ),
    _measured("word", "m.csv:3: z is 'none'", "t,z\n0,1\n1,none\n"),
    _measured("nan", "m.csv:2: z is 'nan'", "t,z\n0,nan\n"),
    _measured("infinite", "m.csv:2: z is 'inf'", "t,z\n0,inf\n"),
    _measured("no-time", "m.csv:3: t is ''", "t,z\n0,1\n,2\n"),
    _measured("ragged", "m.csv:3: 3 values for 2 columns", "t,z\n0,1\n0.5,2,3\n"),
    _measured("early", "m.csv:3: t is -0.1, and the motion lasts from 0 to 1", "t,z\n0,1\n-0.1,2\n"),
    _measured("late", "m.csv:3: t is 1.01, and the motion lasts from 0 to 1", "t,z\n0,1\n1.01,2\n0.3,1\n"),
    _measured(
        "deviation-zero",
        "m.csv:3: s, the standard deviation of z, is 0",
        _FILE.replace("0.3,0.1", "0.3,0"),
        'Measurements("m.csv", values={q: "z"}, sigma={q: "s"})',
    ),
    _measured(
        "deviation-empty",
        "m.csv:5: s, the standard deviation of z, is empty",
        _FILE.replace("0.9,0.1", "0.9,"),
        'Measurements("m.csv", values={q: "z"}, sigma="s")',
    ),
)
_ARGUMENTS = (
    _measured("file-number", "the file of measurements is 3", call='Measurements(3, values={q: "z"})'),
    _measured("text", "observations are 'm.csv'", call='"m.csv"'),
    _called("time-number", "time of measurements m.csv is 0", 'values={q: "z"}, time=0'),
    _called("values-list", "values of measurements m.csv are ['z']", 'values=["z"]'),
    _called("values-empty", "values of measurements m.csv are {}", "values={}"),
    _called("key-text", "have the key 'q'", 'values={"q": "z"}'),
    _called("column-number", "the column of q in measurements m.csv is 3", "values={q: 3}"),
    _called("column-twice", "a column twice", 'values={q: "z", q**2: "z"}'),
    _called("sigma-zero", "sigma of q in measurements m.csv is 0", 'values={q: "z"}, sigma=0'),
    _called("sigma-text", "no column 'w'", 'values={q: "z"}, sigma={q: "w"}'),
    _called("sigma-list", "sigma of q in measurements m.csv is [1]", 'values={q: "z"}, sigma=[1]'),
    _called("sigma-of-another", "sigma of measurements m.csv has the key dq", 'values={q: "z"}, sigma={dq: 1}'),
    _called("sigma-of-one", "m.csv lacks q**2", 'values={q: "z", q**2: "s"}, sigma={q: 1}'),
    _called("loss", "m.csv is 'cauchy'; use one of squares", 'values={q: "z"}, loss="cauchy"'),
    _called("robust-without-sigma", "the loss 'huber' and no sigma", 'values={q: "z"}, loss="huber"'),
    _called("undeclared", "was never declared", 'values={Symbol("y"): "z"}', SymbolError),
    _called("of-control", "what z measures depends on f", 'values={f: "z"}', ExpressionError),
    _called("of-parameter", "which does not move", 'values={parameter("k", 2): "z"}', ExpressionError),
    _measured(
        "each-body",
        "start of q has values of 2 bodies, and there are 1",
        start="{q: each_body(0, 1), dq: 0}",
        error=ExpressionError,
    ),
    _measured("bodies", "there are 1 measurements for bodies=2", bodies="2"),
    _measured("two", "there are 2 measurements for bodies=1", call='[Measurements("m.csv", values={q: "z"})] * 2'),
    _measured(
        "unlike",
        "have other columns",
        call='[Measurements("m.csv", values={q: "z"}), Measurements("m.csv", values={q: "s"})]',
        bodies="2",
    ),
    _measured(
        "tied-bodies",
        "body 0 has observations beside other bodies",
        call='[Measurements("m.csv", values={q: "z"})] * 2',
        error=ExpressionError,
        bodies="2",
        path="[q.of(0) - q.of(1) <= 1]",
    ),
    _measured(
        "delayed",
        "observations beside the delay 1/2 of q",
        error=ExpressionError,
        force="{q: f + q.delayed(0.5)}",
        history="{q: 0}",
    ),
    _measured("maximise", "observations beside maximise", error=ExpressionError, cost="", maximise="-f**2"),
    _measured(
        "free-duration",
        "observations in a motion of free duration",
        error=ExpressionError,
        duration='free_parameter("T", 1)',
    ),
)

_PHASES = """
from codegen import Measurements
(x,), u = states("x"), control("u")
measured = Measurements("m.csv", values={x: "z"})
motion = {"dynamics": {x: u}, "cost": u**2, "duration": 1}
return Phases(Control(**motion, start={x: 0}, observations=measured), Control(**motion, end={x: 1}))
"""
_IN_PHASES = Malformed(
    "measurements-in-phases", file_text(_PHASES), ExpressionError, "phase 1: it has observations", (("m.csv", _FILE),)
)

MALFORMED_MEASUREMENTS = (*_FILES, *_ARGUMENTS, _IN_PHASES)
