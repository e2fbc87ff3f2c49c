"""Texts of modules to be damaged, and damage in them."""

from __future__ import annotations

import re

from conftest import PROBLEMS

from codegen.discretise import transcribe
from codegen.discretise.model.from_problem import load_problem
from codegen.emit import differentiation, lower, rendering
from codegen.emit.differentiation import control_sensitivities
from codegen.emit.lower.module import Origin

ORIGIN = Origin("test.py", "codegen build test.py", "0", ("codegen",))


def prepared_file(name: str, sensitivities: bool = False):
    """The program of a problem file of the gallery, and the text of its module."""
    program = transcribe.transcribe(load_problem(PROBLEMS / f"{name}.py", {}), None, None, "interval")
    mixed = (control_sensitivities(program),) if sensitivities else ()
    return program, rendering.render(lower.lower(program, differentiation.derivatives(program), *mixed), ORIGIN)


def changed(text: str, function: str, pattern: str, replacement: str) -> str:
    """The text with the first match inside a function replaced; the match must exist and matter."""
    begin = text.index(f"def {function}(")
    end = text.index("\n\n\n", begin)
    body, count = re.subn(pattern, replacement, text[begin:end], count=1)
    assert count == 1, f"no {pattern} in {function}"
    return text[:begin] + body + text[end:]
