"""Where the solver of a control problem starts, as strings: guesses of nodes, intervals and shared unknowns."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import sympy
from sympy import Expr, Symbol

from codegen.discretise.model.guesses import DURATION
from codegen.discretise.program import ControlProgram
from codegen.emit.lower.control.layout import inputs, shared_views, slack_indices
from codegen.emit.lower.kernels import Line
from codegen.emit.lower.printer import array_code, scalar_code

FRACTION = Symbol("fraction", real=True)
"""The part of the duration that has passed, of which straight lines between the ends are functions."""


def guesses(program: ControlProgram) -> dict[str, Any]:
    """Guesses as code over arrays of time, and what they read."""
    at_nodes = [replace(line, target=f"nodes[:, :, {line.target}]") for line in _node_guess(program)]
    inside = [replace(line, target=f"intervals[:, :, {line.target}]") for line in _interval_guess(program)]
    measured, between = _through_samples(program)
    at_nodes += [*measured, *_through_inner_times(program)]
    inside = [line for line in inside if line.target not in {other.target for other in between}] + between
    lines = [*_times("grid.nodes", at_nodes), *at_nodes]
    lines += [*_times("(0.5 * (grid.nodes[:-1] + grid.nodes[1:]))", inside), *inside]
    at_inner_times = [value for _, values, _, _ in program.inner.guess for _, value in values]
    duration = (Line("duration", "duration_of(grid, unknowns)"),)
    return {
        "guess_inputs": inputs(
            program, [*program.node_guess, *program.stage_guess, *program.control_guess, *at_inner_times]
        ),
        "guess_lines": (*(duration if _read("duration", lines) else ()), *lines),
        **shared_guesses(program),
    }


def _times(nodes: str, guessed: Sequence[Line]) -> Iterator[Line]:
    """Lines that make the times of guesses, as fractions of the duration or as they are, where guesses read them."""
    if _read(FRACTION.name, guessed):
        yield Line(FRACTION.name, f"{nodes} / grid.steps")
    if _read("t", guessed):
        yield Line("t", f"duration * {nodes} / grid.steps")


def _guess_code(program: ControlProgram, guess: Expr) -> str:
    """Code of a guess over arrays of time, in fractions of the duration where that is all that it depends on."""
    relative = guess.xreplace({program.model.time: FRACTION * DURATION})
    return array_code(guess if relative.has(DURATION) else relative)


def _through_inner_times(program: ControlProgram) -> list[Line]:
    """Lines that lead guesses through values at inner times."""
    lines = []
    for index, values, at_start, at_end in program.inner.guess:
        numbers, codes = [number for number, _ in values], ", ".join(array_code(value) for _, value in values)
        target = f"nodes[:, :, {index}]"
        call = f"through_inner_times(grid, {target}, {numbers}, [{codes}], {at_start}, {at_end})"
        lines.append(Line(target, call))
    return lines


def _through_samples(program: ControlProgram) -> tuple[list[Line], list[Line]]:
    """Lines that lead guesses through what was measured, at nodes and, on straight lines, inside intervals."""
    at_nodes, inside = [], []
    given = [{index for index, *_ in (*end.pins, *end.shared)} for end in (program.start, program.end)]
    for index, column in program.sample.guess if program.sample else ():
        name, target = program.node[index].name, f"nodes[:, :, {index}]"
        call = f"through_samples(grid, {target}, {column}, {index in given[0]}, {index in given[1]})"
        at_nodes.append(Line(target, call, f"{name}, as measured"))
        inner = program.interval[: len(program.stage_guess)]
        stages = [j for j, stage in enumerate(inner) if stage.name.rpartition("_")[0] == name]
        mean = f"0.5 * (nodes[:, :-1, {index}] + nodes[:, 1:, {index}])"
        inside += [Line(f"intervals[:, :, {j}]", mean, program.interval[j].name) for j in stages]
    return at_nodes, inside


def _read(name: str, lines: Sequence[Line]) -> bool:
    """Whether lines read the value of a name."""
    return any(re.search(rf"\b{name}\b", line.code) for line in lines)


def shared_guesses(program: ControlProgram) -> dict[str, Any]:
    """Guesses of shared unknowns as code, and the result."""
    common = program.shared_guess[program.own :]
    return {
        "shared_guess_inputs": (*_scalar_inputs(program, common), *shared_views(program, "own, common", "unknowns")),
        "common_guess": tuple(
            Line(f"common[{j}]", scalar_code(sympy.sympify(value)), unknown.name)
            for j, (unknown, value) in enumerate(zip(program.shared[program.own :], common, strict=True))
        ),
        "own_guess": _own_guess(program),
        "guess_result": "with_slacks(grid, unknowns)" if slack_indices(program) else "unknowns",
    }


def _scalar_inputs(program: ControlProgram, values: Sequence[Expr]) -> tuple[Line, ...]:
    used = set().union(*(value.free_symbols for value in values)) if values else set()
    known = enumerate(program.model.parameters)
    return tuple(Line(s.name, f"grid.parameters[0, {i}]") for i, s in known if s in used)


def _node_guess(program: ControlProgram) -> tuple[Line, ...]:
    lines = [
        Line(str(i), _guess_code(program, guess), program.node[i].name) for i, guess in enumerate(program.node_guess)
    ]
    if program.nodal_controls:
        first = len(program.node) - len(program.model.controls)
        controls = zip(program.model.controls, program.control_guess, strict=True)
        lines += [Line(str(first + i), _guess_code(program, guess), u.name) for i, (u, guess) in enumerate(controls)]
    return tuple(line for line in lines if line.code != "0")


def _interval_guess(program: ControlProgram) -> tuple[Line, ...]:
    """Guesses at the middle of every interval: of stages, and of controls that live there."""
    guessed = list(enumerate(zip(program.interval_symbols, program.stage_guess, strict=False)))
    if not program.nodal_controls:
        controls = zip(program.control_symbols, program.control_guess, strict=True)
        guessed += enumerate(controls, start=len(program.interval))
    lines = [Line(str(i), _guess_code(program, guess), symbol.name) for i, (symbol, guess) in guessed]
    return tuple(line for line in lines if line.code != "0")


def _own_guess(program: ControlProgram) -> tuple[Line, ...]:
    """Guesses of a body's shared unknowns: what a node's unknown equals is read there."""
    lines: dict[int, Line] = {}
    for node, end in (("0", program.start), ("-1", program.end)):
        for index, j, _ in end.shared:
            if j < program.own:
                lines.setdefault(j, Line(f"own[:, {j}]", f"nodes[:, {node}, {index}]", program.shared[j].name))
    return tuple(lines.values())
