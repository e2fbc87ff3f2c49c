"""Output of `codegen solve`: a JSON object, tables, an archive of arrays, and notes on a module from its metadata."""

from __future__ import annotations

import ast
import json
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, cast

from codegen.errors import ArgumentError
from codegen.files import replacing
from codegen.runtime import record
from codegen.runtime.record import ControlRecord, Record, Task
from codegen.solving.results import estimates, sensitivities
from codegen.solving.results.estimates import as_finite

if TYPE_CHECKING:
    from rich.table import Table

    from codegen.solving.results.result import Result

JsonObject: TypeAlias = Mapping[str, Any]
"""An object of JSON: numbers, texts, lists and objects by name."""
ARCHIVES = (".npz",)


def require_writable(path: Path, kinds: tuple[str, ...], option: str) -> None:
    """Raise ArgumentError, which names the command-line `option`, if the file cannot be written.

    `kinds` are the permitted endings of the file name, such as ".npz".
    """
    if path.suffix.lower() not in kinds:
        raise ArgumentError(f"{option} {path}: unknown kind of file", f"let it end in {' or '.join(kinds)}")
    if path.is_dir():
        raise ArgumentError(f"{option} {path}: is a directory", "give the name of a file")
    require_folder(path.absolute().parent, option)


def require_folder(folder: Path, option: str, may_be_made: bool = False) -> None:
    """Raise ArgumentError, which names the command-line `option`, if no file can be written to the folder.

    If `may_be_made` is True, the folder may be missing, provided that it can be created.
    """
    while may_be_made and not folder.exists() and folder != folder.parent:
        folder = folder.absolute().parent
    if not folder.exists():
        raise ArgumentError(f"{option}: there is no folder {folder}", "make it, or choose another")
    if not folder.is_dir():
        raise ArgumentError(f"{option}: {folder} is not a folder", "choose a folder")
    try:
        # Permissions are not sufficient, because the file system may be read-only.
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        finding = f"{option}: nothing can be written to {folder} ({error.strerror})"
        raise ArgumentError(finding, "choose another folder") from error


def as_record(result: Result, build: float, load: float) -> dict[str, Any]:
    """Return the object that `--json` prints; numbers that are not finite are None.

    `build` and `load` are the seconds for deriving and for loading the module.
    """
    names = ("problem", "task", "method", "scheme", "driver", "steps", "status", "message")
    record: dict[str, Any] = {
        **{name: getattr(result, name) for name in names},
        **({"parameters": dict(result.parameters)} if result.parameters else {}),
        "cost": as_finite(result.cost),
        "residual": as_finite(result.residual),
        "iterations": result.iterations,
        "seconds": {"build": as_finite(build), "load": as_finite(load), "solve": as_finite(result.seconds_solve)},
        "summary": {name: as_finite(value) for name, value in result.summary.items()},
    }
    if result.notes:
        record["notes"] = list(result.notes)
    if result.levels:
        record["levels"] = [
            {"steps": level.steps, "status": level.status, "message": level.message, "iterations": level.iterations,
             "cost": as_finite(level.cost), "residual": as_finite(level.residual),
             "seconds": as_finite(level.seconds_solve)}
            for level in result.levels
        ]  # fmt: skip
    if accuracy := result.accuracy:
        history = [
            {"intervals": level.intervals, "status": level.status, "error": as_finite(level.error),
             "iterations": level.iterations, "seconds": as_finite(level.seconds)}
            for level in accuracy.levels
        ]  # fmt: skip
        record["accuracy"] = {
            "request": accuracy.request, "reached": not accuracy.reason, "estimate": as_finite(accuracy.estimate),
            "largest": {"quantity": accuracy.quantity, "t": as_finite(accuracy.time)}, "reason": accuracy.reason,
            "history": history, "t": [as_finite(time) for time in result.t],
        }  # fmt: skip
    if result.estimates:
        record["estimates"] = estimates.as_record(result.estimates)
    if result.sensitivity:
        record["sensitivities"] = sensitivities.as_record(result.sensitivity, result)
    return record


def as_json(record: JsonObject) -> str:
    """Return the record as one line of strict JSON; raise ValueError for NaN and infinity."""
    return json.dumps(record, allow_nan=False)


def with_unit(number: str, unit: str) -> str:
    """Return the text of a number followed by its unit; an empty unit is omitted."""
    return f"{number} {unit}" if unit else number


def given(result: Result) -> str:
    """Return the parameter overrides of a solve as text, for example `m = 2 kg, g = 1.6`."""
    own = [(name, with_unit(_number(value), result.unit_of(name))) for name, value in result.parameters.items()]
    return ", ".join(f"{name} = {value}" for name, value in own)


def as_table(record: JsonObject, result: Result) -> Table:
    """Return the table of a result that the command prints; `record` is the object from `as_record`."""
    from rich import box
    from rich.table import Table

    table = Table(box=box.SIMPLE_HEAD, show_header=False)
    table.add_column(style="cyan", no_wrap=True)
    table.add_column()
    table.add_row("problem", f"{record['problem']} ({record['task']})")
    table.add_row("discretisation", f"{record['method']}, {record['scheme']}, {result.intervals}")
    if result.parameters:
        table.add_row("given", _escaped(given(result)))
    style = "green" if record["status"] == "solved" else "bold red"
    table.add_row("status", f"[{style}]{record['status']}[/]")
    table.add_row("", _escaped(record["message"]))
    for note in record.get("notes", ()):
        table.add_row("[bold red]note[/]", f"[bold red]{_escaped(note)}[/]")
    if record["cost"] is not None:
        table.add_row("cost", with_unit(f"{record['cost']:.12g}", result.units.get("cost", "")))
    table.add_row("residual", _number(record["residual"]))
    table.add_row("iterations", f"{record['iterations']} ({record['driver']})")
    for level in record.get("levels", ()):
        cost = "" if level["cost"] is None else f", cost {level['cost']:.12g}"
        table.add_row("grid", f"{level['steps']} steps: {level['status']}{cost}, {level['iterations']} iterations")
    if accuracy := record.get("accuracy"):
        for level in accuracy["history"]:
            words = f"{level['intervals']} intervals: {level['status']}, error {_number(level['error'])}"
            table.add_row("grid", f"{words}, {level['iterations']} iterations, {_duration(level['seconds'])}")
        largest = f"{_number(accuracy['estimate'])}, largest of {accuracy['largest']['quantity']}"
        table.add_row("estimated error", f"{largest} at t = {_number(accuracy['largest']['t'])}")
    for name, value in record["summary"].items():
        table.add_row(_escaped(result.label(name)), with_unit(_number(value), result.unit_of(name)))
    seconds = record["seconds"]
    table.add_row("time", ", ".join(f"{name} {_duration(value)}" for name, value in seconds.items()))
    return table


def estimates_tables(record: JsonObject) -> list[Table]:
    """Return the table of free parameters with their accuracy, and the table of their correlations.

    `record` is the entry "estimates" of the object for `--json`. The second table is omitted for a single parameter,
    and for more than `_CORRELATED` parameters.
    """
    table, names = _titled_table("Estimates"), list(record["parameters"])
    table.caption, table.caption_justify = "standard errors from the reduced Hessian", "left"
    if record["deviation_is_estimated"]:
        errors = f"standard deviation of errors {_number(record['deviation'])}"
        table.caption += f"; {errors}, {record['degrees_of_freedom']} degrees of freedom"
    table.add_column("parameter", style="cyan", no_wrap=True)
    for heading in ("value", "standard error", "Gauss-Newton", f"{100 * record['confidence']:g} % interval"):
        table.add_column(heading, justify="right")
    for name, found in record["parameters"].items():
        low, high = found["interval"]
        interval = "not available" if low is None else f"{_number(low)} to {_number(high)}"
        numbers = (found[key] for key in ("value", "standard_error", "gauss_newton_error"))
        table.add_row(name, *map(_number, numbers), interval)
    if not 1 < len(names) <= _CORRELATED:
        return [table]
    correlations_table = _titled_table("Correlations")
    correlations_table.add_column("", style="cyan", no_wrap=True)
    for name in names[:-1]:
        correlations_table.add_column(name, justify="right")
    for number, (name, row) in enumerate(zip(names, record["correlations"], strict=True)):
        if number:
            correlations_table.add_row(name, *("" if entry is None else f"{entry:.3f}" for entry in row[:number]))
    return [table, correlations_table]


def sensitivities_table(record: JsonObject) -> Table:
    """Return the table of sensitivities, with a row for each quantity with respect to which derivatives were taken.

    The columns are the derivatives of the cost, of free parameters and of the first states at the end. `record` is the
    entry "sensitivities" of the object for `--json`.
    """
    table, rows = _titled_table("Sensitivities"), record["by"]
    first = next(iter(rows.values()))
    free, end = list(first["free_parameters"]), list(first["end"])[:_SHOWN]
    table.add_column("by", style="cyan", no_wrap=True)
    for heading in ("cost", *free, *(f"{name} at the end" for name in end)):
        table.add_column(heading, justify="right")
    for name, found in rows.items():
        numbers = [found["cost"], *found["free_parameters"].values(), *(found["end"][key] for key in end)]
        table.add_row(_escaped(name), *map(_number, numbers))
    return table


_SHOWN = 4
"""Number of states at the end in the table of sensitivities; `--json` prints all states."""
_CORRELATED = 10
"""Largest number of free parameters for which a table of correlations is printed; `--json` prints all correlations."""


def log_table(result: Result) -> Table:
    """Return the table of the iterates of the generated solver."""
    table = _titled_table("Iterations")
    rows = result.log if result.log is not None else ()
    headings = ["iteration", "cost", "residual", "stationarity", "shift", "step"]
    if any(len(row) > len(headings) - 1 for row in rows):  # only the interior point method has a barrier parameter
        headings.append("barrier")
    for heading in headings:
        table.add_column(heading, justify="right")
    for k, row in enumerate(rows):
        cost, residual, stationarity, shift, length, *barrier = row
        errors = f"{residual:.2e}", f"{stationarity:.2e}"
        weight = (f"{mu:.1e}" for mu in barrier)
        table.add_row(str(k), f"{cost:.12g}", *errors, f"{shift:.1e}" if shift else "", f"{length:g}", *weight)
    return table


def _titled_table(title: str) -> Table:
    from rich import box
    from rich.table import Table

    return Table(title=title, title_justify="left", title_style="bold", box=box.SIMPLE_HEAD)


def _escaped(text: str) -> str:
    from rich.markup import escape

    return escape(text)


def _number(value: float | None) -> str:
    return "not available" if value is None else f"{value:.6g}"


def _duration(seconds: float | None) -> str:
    if seconds is None:
        return "not available"
    for limit, factor, unit in ((1e-3, 1e6, "µs"), (1.0, 1e3, "ms")):
        if seconds < limit:
            return f"{seconds * factor:.3g} {unit}"
    return f"{seconds:.3g} s"


def save(result: Result, record: JsonObject, path: Path) -> None:
    """Write all arrays of a result to an .npz archive.

    The entry `result` of the archive is `record`, the object for `--json`, as text.
    """
    import numpy as np

    names = ("t", "q", "p", "u", "multipliers", "energy", "log", "unknowns")
    arrays: dict[str, Any] = {name: getattr(result, name) for name in names if getattr(result, name) is not None}
    if result.u is not None:
        arrays["u_times"] = result.control_times
    if result.events is not None:
        events = result.events
        arrays |= {"event_names": np.array(events.names), "event_actions": np.array([str(a) for a in events.actions])}
        arrays |= {"event_times": events.t, "event_before": events.before, "event_after": events.after}
    if result.sensitivity is not None:
        arrays |= sensitivities.as_arrays(result.sensitivity)
    labels: dict[str, Any] = {f"{name}_names": np.array(columns) for name, columns in result.names.items() if columns}
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **arrays, **labels, result=np.array(as_json(record)))


NAME = 40
"""Number of characters to which the text of a condition is shortened in notes.

The condition on an interior angle of a polygon, for example, would fill six lines.
"""


def notes(record: Record) -> list[str]:
    """Return warnings about the problem of a module, such as unused symbols, omitted conditions and kinks."""
    lines = []
    if unused := record.unused:
        lines.append(f"{', '.join(unused)} {'is' if len(unused) == 1 else 'are'} declared but never used")
    if record.task != Task.CONTROL:
        return lines
    metadata = cast(ControlRecord, record)
    if redundant := metadata.redundant_conditions:
        named = ", ".join(f"number {number} ({shortened(name)})" for number, name in redundant)
        verb = "follows from the others and was" if len(redundant) == 1 else "follow from the others and were"
        count = f"{len(redundant)} of {metadata.coupling_conditions}"
        lines.append(f"{count} conditions between bodies {verb} left out: {named}")
    for quantity, where in metadata.dependent_values:
        lines.append(
            f"{shortened(quantity)} at the {where} follows from the path equalities with the other values at the ends, "
            "and was left out"
        )
    for condition, where in metadata.decided_conditions:
        lines.append(
            f"{shortened(condition)} holds with equality at the {where}, by what is prescribed there, and was left out"
        )
    for name, value, last in metadata.history_jumps:
        lines.append(f"{name} starts at {value}, where its history ends at {last}: its values of the past jump there")
    if kinks := metadata.kinks:
        named = ", ".join(map(shortened, kinks))
        lines.append(
            f"{named} has a kink, at which Newton's method stalls: write a - b for u, a + b for Abs(u), a for "
            "Max(u, 0) and -b for Min(u, 0), with controls a, b >= 0, or a control that is bounded by both sides of a "
            "Max"
        )
    if borders := metadata.discontinuities:
        named = ", ".join(map(shortened, borders))
        lines.append(
            f"something jumps where {named} changes, which derivatives do not see: make it smooth, as by "
            "(1 + tanh(s/width))/2, or give each side a phase of its own"
        )
    for function, what, where in metadata.singular_at_guess:
        inside, instead = function.removeprefix("sqrt(")[:-1], ""
        if function.startswith("sqrt(") and " + " in inside:
            instead = f"; for a length in the cost, a control c >= 0 in its place with path {inside} <= c**2"
        lines.append(
            f"{shortened(function)} has no finite {what} at the guess, {where}, where a search cannot begin: give "
            f"another guess, or bounds that keep away from there{instead}"
        )
    if unseen := metadata.unseen_controls:
        lines.append(
            f"the scheme averages nodal controls, and their alternation costs nothing ({', '.join(unseen)}): the "
            "solution may be no optimum; codegen check explains, and --controls interval has no such mode"
        )
    return lines


def notes_of_file(path: Path) -> list[str]:
    """Return the warnings about the problem of a module in a file, without importing the module."""
    return notes(record_in(path.read_text(encoding="utf-8")))


def record_in(text: str) -> Record:
    """Return the record, the metadata of a generated module, from the source text of the module."""
    assigned = (node for node in ast.parse(text).body if isinstance(node, ast.Assign))
    made = next(node.value for node in assigned if getattr(node.targets[0], "id", "") == "metadata")
    return cast(Record, eval(compile(ast.Expression(made), "metadata", "eval"), dict(vars(record))))


def shortened(name: str, limit: int = NAME) -> str:
    """Return the name, or its first `limit` characters followed by " ..." if it is longer."""
    return name if len(name) <= limit else name[:limit].rstrip() + " ..."
