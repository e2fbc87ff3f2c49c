"""Rendering of a `Module` as the text of one Python file, and atomic writing of changed text.

The loops in `templates/loops.txt` serve every problem. Sizes such as SHARED are known when a module is generated, so
that `if SHARED:` and `for j in range(SHARED):` are decided at that time. The body of such a branch is included without
the test, or left out. No module has branches, loops or summands of absent features.
"""

from __future__ import annotations

import ast
import hashlib
import re
import textwrap
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import MISSING, fields, is_dataclass, replace
from enum import Enum
from functools import cache
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING

from codegen.files import refused, write_text
from codegen.identifiers import renamed, renamed_arguments

if TYPE_CHECKING:
    import jinja2
    from _typeshed import DataclassInstance

    from codegen.emit.lower.module import Module, Origin

_DIGEST = "@@digest@@"
"""Placeholder for the digest of the rest of a text."""
_IDENTITY = re.compile(r"^# Text: sha256 ([0-9a-f]{16})$", re.MULTILINE)
"""The comment line with the digest in a finished text."""
_WIDTH = 114
"""Largest width of a line with the arguments of a record, without the indentation."""
_OF_NUMBA = ("carray", "njit", "prange")
"""Names that generated modules import from numba."""

_PUBLIC = (
    "evaluate", "initial_guess", "make_grid", "metadata", "multiplier_unknowns", "nlp", "primal_unknowns", "problem",
    "solve", "unpack", "views", "with_pinned_values",
)  # fmt: skip
"""Public names of a module that solves an optimal control problem."""


_OF_KERNELS = ("record", "special", "tabulated", "formulas")
_OF_PAIRS = ("record", "kernels", "arithmetic", "particles.problem")
_IMPORTED = {
    "control.py.j2": (
        "search.problem", "search.structure", "search.grid", "search.point", "search.bounds", "search.nlp",
        "search.solution", "search.sensitivities", "search.shooting", *_OF_KERNELS,
    ),
    "simulate.py.j2": ("kernels", "stepping.problem", "stepping.steps", "stepping.motion", *_OF_KERNELS),
    "connect.py.j2": (
        *_OF_PAIRS, "particles.shooting", "particles.cascade", "particles.least_action", "particles.callbacks",
        "particles.tracers",
    ),
    "particles.py.j2": (*_OF_PAIRS, "particles.motion"),
}  # fmt: skip
"""Modules of `codegen.runtime` from which generated modules may import, by the name of the template."""


def render(module: Module, origin: Origin) -> str:
    """Return the text of a generated module; its template reads values by name and has no logic."""
    values = {field.name: getattr(module, field.name) for field in fields(module)}
    values |= {field.name: getattr(origin, field.name) for field in fields(origin)}
    names = [argument.name for argument in (*module.arguments, *getattr(module, "own", ()))]
    record = replace(module.metadata, inputs=origin.inputs)
    of_record = {entry.name: getattr(record, entry.name) for entry in fields(record)}
    long = {name: value for name, value in of_record.items() if isinstance(value, tuple) and len(_code(value)) > _WIDTH}
    lines = _filled(a for a in _arguments(record) if a.partition("=")[0] not in long)
    for name, value in long.items():
        lines += [f"{name}=(", *(f"    {line}" for line in _filled(map(_code, value))), "),"]
    values |= {
        "description": (*module.description, *renamed_arguments(names)),
        "title": module.title.replace("\\", "\\\\").replace('"', '\\"'),  # for use between triple quotes
        "record_type": type(module.metadata).__name__,
        "record_lines": lines,
        "imports": (),
        "numba_imports": (),
    }
    if module.template == "control.py.j2":
        sizes = dict(module.sizes)
        loops = resources.files("codegen.emit").joinpath("templates/loops.txt").read_text(encoding="utf-8")
        values["loops"] = specialise(loops, sizes).strip()
        values["public"] = (
            *_PUBLIC,
            *(("variable_bounds",) if sizes["INEQUALITIES"] else ()),
            *(("sensitivities", "unpacked_rates") if sizes["SENSITIVE"] else ()),
        )
    template = _environment().get_template(module.template)
    body = template.render(values, identity=_DIGEST)
    # Public names and undefined names are imported from modules of the runtime, or from numba.
    files = _IMPORTED[module.template]
    tree, wanted = ast.parse(body), dict[str, set[str]]()
    used = set(values["public"]).union(*map(names_read, tree.body))
    defined = {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}
    for name in used - defined:
        if name in _importable(files):
            wanted.setdefault(_importable(files)[name], set()).add(name)
        elif name in _OF_NUMBA:
            wanted.setdefault("numba", set()).add(name)
    imports = tuple(f"from {module} import {', '.join(sorted(wanted[module]))}" for module in sorted(wanted))
    values["numba_imports"] = [line for line in imports if line.startswith("from numba ")]
    values["imports"] = [line for line in imports if not line.startswith("from numba ")]
    written = template.render(values, identity=_DIGEST)
    # No trailing blanks, two empty lines at most, one newline at the end.
    written = "\n".join(line.rstrip() for line in written.splitlines())
    named = renamed(re.sub(r"\n{4,}", "\n\n\n", written).strip("\n") + "\n")
    text = named.replace(_DIGEST, _digest(named.replace(_DIGEST, "")))
    compile(text, f"{module.name}.py", "exec")
    return text


@cache
def _environment() -> jinja2.Environment:
    """Return the jinja environment, which keeps compiled templates: compilation takes longer than rendering."""
    import jinja2

    return jinja2.Environment(
        loader=jinja2.PackageLoader("codegen.emit"),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=False,
        autoescape=False,
    )


def names_read(part: ast.stmt) -> set[str]:
    """Return the names in a statement; of a function, without its arguments and the names that it assigns."""
    names = [node for node in ast.walk(part) if isinstance(node, ast.Name)]
    own = {node.arg for node in ast.walk(part) if isinstance(node, ast.arg)}
    own |= {node.id for node in names if isinstance(node.ctx, ast.Store)}
    return {node.id for node in names} - (own if isinstance(part, ast.FunctionDef) else set())


@cache
def _importable(files: tuple[str, ...]) -> dict[str, str]:
    """Return a map from each public name in the given modules of the runtime to the module that defines it."""
    modules = {}
    for path in files:
        file = resources.files("codegen.runtime").joinpath(*path.split(".")[:-1], f"{path.split('.')[-1]}.py")
        tree = ast.parse(file.read_text(encoding="utf-8"))
        for node in tree.body:
            if isinstance(node, (ast.FunctionDef, ast.ClassDef)) and not node.name.startswith("_"):
                modules[node.name] = f"codegen.runtime.{path}"
    return modules


def _filled(arguments: Iterable[str]) -> list[str]:
    """Return the arguments joined to lines of limited width; an argument that is too long has a line of its own."""
    lines = list[str]()
    for argument in arguments:
        if lines and len(lines[-1]) + len(argument) < _WIDTH:
            lines[-1] += f" {argument},"
        else:
            lines.append(f"{argument},")
    return lines


def _arguments(record: DataclassInstance) -> Iterator[str]:
    """Yield the code of each argument of the call that creates a dataclass; arguments equal to defaults are omitted."""
    positional = True
    for entry in fields(record):
        value = getattr(record, entry.name)
        if value == (entry.default if entry.default_factory is MISSING else entry.default_factory()):
            positional = False
            continue
        yield _code(value) if positional and not entry.kw_only else f"{entry.name}={_code(value)}"


def _code(value: object) -> str:
    """Return Python code that creates a value: an enum member, a dataclass, a container or a literal."""
    if isinstance(value, Enum):
        return f"{type(value).__name__}.{value.name}"
    if is_dataclass(value) and not isinstance(value, type):
        return f"{type(value).__name__}({', '.join(_arguments(value))})"
    if isinstance(value, tuple):
        return f"({', '.join(map(_code, value))}{',' * (len(value) == 1)})"
    if isinstance(value, Mapping):
        return f"{{{', '.join(f'{_code(key)}: {_code(entry)}' for key, entry in value.items())}}}"
    return repr(value)


_Site = ast.If | ast.For | ast.BinOp
"""Syntax nodes that a known size may simplify: branches, loops and sums."""


def specialise(text: str, sizes: Mapping[str, int]) -> str:
    """Return source text without branches on the given sizes, and without empty loops and zero summands.

    `sizes` has the value of each name. Branches are `if NAME:` or `if NAME and other:`, possibly with `else`, but not
    with `elif`. Of loops `for ... in range(NAME):` and sums `... + NAME`, those with a size of zero are removed.
    """
    names, zeros = "|".join(sizes), "|".join(name for name, size in sizes.items() if size == 0)
    tests, empty = rf"\bif ({names})\b", rf"(\bin range\(|\+ )({zeros})\b"
    # Parsing is slow: first search for text that a size may decide.
    while (names and re.search(tests, text)) or (zeros and re.search(empty, text)):
        lines, chosen = text.splitlines(), list[_Site]()
        # A node inside another chosen node, or on one of its lines, waits for the next round.
        for node in ast.walk(ast.parse(text)):
            if (
                isinstance(node, _Site)
                and _decided(node, lines, sizes)
                and not any((node.lineno <= (c.end_lineno or 0) and c.lineno <= (node.end_lineno or 0)) for c in chosen)
            ):
                chosen.append(node)
        if not chosen:
            return text
        for node in sorted(chosen, key=lambda node: -node.lineno):  # so that lines above keep their numbers
            lines = _decided(node, lines, sizes) or lines
        text = "\n".join(lines) + "\n"
    return text


def _decided(node: _Site, lines: list[str], sizes: Mapping[str, int]) -> list[str] | None:
    """Return the lines of a text with one syntax node simplified, or None if no size decides the node."""
    if isinstance(node, ast.BinOp):
        name = getattr(node.right, "id", "")
        if not isinstance(node.op, ast.Add) or sizes.get(name, 1) or node.lineno != node.end_lineno:
            return None
        row, (begin, end) = node.lineno - 1, (node.left.end_col_offset, node.right.end_col_offset)
        line = lines[row].encode()  # columns count bytes
        assert line[begin:end] == f" + {name}".encode(), "a left operand in parentheses"
        return [*lines[:row], (line[:begin] + line[end:]).decode(), *lines[row + 1 :]]
    if isinstance(node, ast.For):
        empty = isinstance(node.iter, ast.Call) and [sizes.get(getattr(a, "id", ""), 1) for a in node.iter.args] == [0]
        return _replaced(lines, node, []) if empty else None
    combined = isinstance(node.test, ast.BoolOp) and isinstance(node.test.op, ast.And)
    name = getattr(node.test.values[0] if isinstance(node.test, ast.BoolOp) and combined else node.test, "id", "")
    if name not in sizes:
        return None
    # An `elif` has the syntax tree of an `if` in an `else`.
    elifs = [s for s in node.orelse if isinstance(s, ast.If) and lines[s.lineno - 1].lstrip().startswith("elif ")]
    assert not elifs, f"an elif after {name}"
    if sizes[name] == 0:
        return _replaced(lines, node, node.orelse)
    if combined:
        first = node.lineno - 1
        return [*lines[:first], lines[first].replace(f"{name} and ", "", 1), *lines[first + 1 :]]
    return _replaced(lines, node, node.body)


def _replaced(lines: list[str], node: ast.If | ast.For, kept: list[ast.stmt]) -> list[str]:
    """Return the lines with a statement replaced by `kept`, some of the statements inside it."""
    inner = list[str]()
    if kept:
        decorators: list[ast.expr] = getattr(kept[0], "decorator_list", [])
        first = min([kept[0].lineno, *(decorator.lineno for decorator in decorators)])
        inner = lines[first - 1 : kept[-1].end_lineno]
    body = textwrap.indent(textwrap.dedent("\n".join(inner)), " " * node.col_offset).splitlines()
    return [*lines[: node.lineno - 1], *body, *lines[node.end_lineno :]]


def is_whole(text: str) -> bool:
    """Return True if a text is unchanged since rendering: its digest agrees with the rest of the text."""
    match = _IDENTITY.search(text)
    return match is not None and _digest(text.replace(match[1], "", 1)) == match[1]


def signed(text: str) -> str:
    """Return an edited text with an updated digest."""
    match = _IDENTITY.search(text)
    assert match is not None, "a generated text holds its digest"
    return text.replace(match[1], _digest(text.replace(match[1], "", 1)), 1)


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def write(path: Path, text: str) -> bool:
    """Write a text to a file atomically if the file has another text; return True if the file was written.

    A reader sees the old file or the new one, and a killed build leaves the old one. Raises FileError if the file
    system refuses to write.
    """
    try:
        if path.is_file() and path.read_bytes() == text.encode():
            return False
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise refused(error, path) from error
    write_text(path, text)
    return True
