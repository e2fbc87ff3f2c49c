"""Malformed problem files: the templates of which they are made."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from codegen.errors import CodegenError


@dataclass(frozen=True)
class Malformed:
    """A malformed problem file, and the error class and the part of its message that reading it must cause.

    `files` are pairs (name, text) of what lies beside it.
    """

    id: str
    text: str
    error: type[CodegenError]
    fragment: str
    files: tuple[tuple[str, str], ...] = ()

    def write(self, folder: Path) -> Path:
        """Write the problem as `broken.py` into a folder, and what lies beside it; return its path."""
        for name, text in (*self.files, ("broken.py", self.text)):
            (folder / name).write_bytes(text.encode(errors="surrogateescape"))
        return folder / "broken.py"


PRELUDE = '''"""A malformed problem."""

from sympy import *

from codegen import Control, Phases, Simulate, canonical_pair, control, controls, coordinate, coordinates
from codegen import body_number, free_parameter, parameter, parameters, states, time
'''
"""The sound beginning of a file, which every body below follows."""


def file_text(body: str, signature: str = "") -> str:
    """A problem file whose function `problem` has the given body."""
    lines = "".join(f"    {line}\n" for line in body.strip().splitlines())
    return f"{PRELUDE}def problem({signature}):\n{lines}"


def simulation(declare: str = "", **changes: str) -> str:
    """A file with a sound simulation of an oscillator, where some lines and arguments are replaced."""
    arguments = {"lagrangian": "dq**2/2 - q**2/2", "duration": "1", "start": "{q: 0, dq: 1}", **changes}
    return _problem("Simulate", 'q, dq = coordinate("q")\n' + declare, arguments)


def optimal(declare: str = "", **changes: str) -> str:
    """A file with a sound control of an oscillator, where some lines and arguments are replaced."""
    arguments = {
        "lagrangian": "dq**2/2 - q**2/2",
        "force": "{q: f}",
        "cost": "f**2",
        "duration": "1",
        "start": "{q: 0, dq: 0}",
        "end": "{q: 1, dq: 0}",
        **changes,
    }
    return _problem("Control", 'q, dq = coordinate("q")\nf = control("f")\n' + declare, arguments)


def first_order(declare: str = "", **changes: str) -> str:
    """A file with a sound control of a first-order system, where some lines and arguments are replaced."""
    arguments = {
        "dynamics": "{x: v, v: u}",
        "cost": "u**2",
        "duration": "1",
        "start": "{x: 0, v: 0}",
        "end": "{x: 1, v: 0}",
        **changes,
    }
    return _problem("Control", 'x, v = states("x v")\nu = control("u")\n' + declare, arguments)


def group(declare: str = "", **changes: str) -> str:
    """A file with a sound control of two bodies that meet, where some lines and arguments are replaced."""
    arguments = {
        "lagrangian": "(dx**2 + dy**2)/2",
        "force": "{x: f, y: g}",
        "cost": "f**2 + g**2",
        "duration": "1",
        "start": "{x: body, y: 0, dx: 0, dy: 0}",
        "end": "{dx: 0, dy: 0}",
        "end_conditions": "[x.of(0) - x.of(1), y.of(0) - 1, y.of(1) - 2]",
        "bodies": "2",
        **changes,
    }
    symbols = '(x, y), (dx, dy) = coordinates("x y")\nf, g = controls("f g")\nbody = body_number()\n'
    return _problem("Control", symbols + declare, arguments)


def phased(
    declare: str = "",
    first: dict[str, str] | None = None,
    second: dict[str, str] | None = None,
    jumps: str = "",
    phases: str = "",
) -> str:
    """A file with a sound control of a first-order system in two phases, where lines and arguments are replaced."""
    motion = {"dynamics": "{x: v, v: u}", "cost": "u**2", "duration": "1"}
    given = [motion | {"start": "{x: 0, v: 0}"} | (first or {}), motion | {"end": "{x: 2, v: 0}"} | (second or {})]
    written = [", ".join(f"{name}={value}" for name, value in arguments.items() if value) for arguments in given]
    controls = [f"{name} = Control({arguments})" for name, arguments in zip(("first", "second"), written, strict=True)]
    result = phases or f"Phases(first, second{f', jumps={jumps}' if jumps else ''})"
    symbols = 'x, v = states("x v")\nu = control("u")'
    return file_text("\n".join([symbols, declare, *controls, f"return {result}"]))


def declaring(line: str) -> str:
    """A sound simulation with one more line of declarations in front."""
    return simulation(line)


def _problem(kind: str, declare: str, arguments: dict[str, str]) -> str:
    written = ", ".join(f"{name}={value}" for name, value in arguments.items() if value)
    return file_text(f"{declare}\nreturn {kind}({written})")
