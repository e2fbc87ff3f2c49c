"""Module -> text of one Python file, and that text -> disk, atomically and only when it changed."""

from __future__ import annotations

import ast
import hashlib
import re
import sys
from collections.abc import Iterator
from dataclasses import fields
from functools import cache, lru_cache
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jinja2

from codegen.emit.specialise import specialise
from codegen.files import refused, write_text
from codegen.mangling import renamed, renamed_arguments

if TYPE_CHECKING:  # a build that the cache answers writes files without ever importing sympy
    from codegen.lower.module import Module, Origin


_NAME = "@@digest@@"
"""Where a text's own name comes, which depends on all the rest of the text."""
_IDENTITY = re.compile(r'^(?:_IDENTITY = "codegen_\w+?_|# Text: sha256 )([0-9a-f]{16})"?$', re.MULTILINE)
"""The line that tells it."""
_SPECIAL = ("polygamma", "sinc_derivative")


def render(module: Module, origin: Origin) -> str:
    """The text of a generated module; its template asks for values by name, and decides nothing."""
    values = {field.name: getattr(module, field.name) for field in fields(module)}
    values |= {field.name: getattr(origin, field.name) for field in fields(origin)}
    if module.template == "control.py.j2":
        return _render_control(module, values)
    # Functions that kernels call and Python does not have: a file for each.
    special = tuple(name for name in _SPECIAL if f"{name}(" in repr(module) or f"{name})(" in repr(module))
    runtime = ("packing", *special, *module.runtime)
    names = [argument.name for argument in (*module.arguments, *getattr(module, "own", ()))]
    values |= {
        "description": (*module.description, *renamed_arguments(names)),
        "numba_names": numba_names(runtime),
        "runtime": runtime_source(runtime, module.sizes),
        "machine_code_cache": runtime_source(("machine_code_cache",)),
        "imports": standard_imports(runtime),
        "title": _in_docstring(module.title),
        "title_code": repr(module.title),
        "left_out_code": [repr(line) for line in module.left_out],
    }
    named = renamed(_tidy(_environment().get_template(module.template).render(values, identity=_NAME)))
    # numba's cache needs a name that belongs to this text alone; see the end of a generated module.
    text = named.replace(_NAME, _digest(named.replace(_NAME, "")))
    compile(text, f"{module.name}.py", "exec")
    return text


def _render_control(module: Module, values: dict[str, Any]) -> str:
    """The text of a module that imports what is common to all problems."""
    names, sizes = [argument.name for argument in module.arguments], dict(module.sizes)
    public = (
        *_PUBLIC,
        *(("variable_bounds",) if sizes["INEQUALITIES"] else ()),
        *(("sensitivities", "unpacked_rates") if sizes["SENSITIVE"] else ()),
    )
    loops = resources.files("codegen.emit").joinpath("templates/loops.txt").read_text(encoding="utf-8")
    values |= {
        "description": (*module.description, *renamed_arguments(names)),
        "loops": specialise(loops, sizes).strip(),
        "title": _in_docstring(module.title),
        "title_code": repr(module.title),
        "left_out_code": [repr(line) for line in module.left_out],
        "public": public,
        "imports": (),
    }
    template = _environment().get_template(module.template)
    body = template.render(values, identity=_NAME)
    values["imports"] = _imports_of(body, public)
    named = renamed(_tidy(template.render(values, identity=_NAME)))
    text = named.replace(_NAME, _digest(named.replace(_NAME, "")))
    compile(text, f"{module.name}.py", "exec")
    return text


_PUBLIC = (
    "constraints", "cost", "cost_gradient", "evaluate", "hessian", "initial_guess", "jacobian", "make_grid",
    "metadata", "multiplier_unknowns", "primal_unknowns", "problem", "solve", "stationarity", "unpack", "views",
    "with_pinned_values",
)  # fmt: skip
"""Names for users of a module that solves an optimal control problem."""


@cache
def _importable() -> dict[str, str]:
    """Names that a module may import, with the modules of the runtime that define them."""
    found = {}
    for path in _IMPORTED:
        file = resources.files("codegen.runtime").joinpath(*path.split(".")[:-1], f"{path.split('.')[-1]}.py")
        tree = ast.parse(file.read_text(encoding="utf-8"))
        for node in tree.body:
            if isinstance(node, (ast.FunctionDef, ast.ClassDef)) and not node.name.startswith("_"):
                found[node.name] = f"codegen.runtime.{path}"
    return found


_IMPORTED = (
    "search.problem", "search.structure", "search.grid", "search.point", "search.samples", "search.callbacks",
    "search.parts", "search.slacks", "search.solution", "search.sensitivities", "inner_number", "special.polygamma",
    "special.sinc_derivative", "tabulated.table_cells", "tabulated.table_curves", "tabulated.table_surfaces",
    "tabulated.table_guesses",
)  # fmt: skip
"""Modules of the runtime from which generated modules import."""


def _imports_of(text: str, public: tuple[str, ...]) -> tuple[str, ...]:
    """The lines that import what a text uses and does not define, and what it offers."""
    tree, wanted = ast.parse(text), dict[str, set[str]]()
    used = {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)} | set(public)
    own = {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}
    for name in used - own:
        if name in _importable():
            wanted.setdefault(_importable()[name], set()).add(name)
    return tuple(f"from {module} import {', '.join(sorted(wanted[module]))}" for module in sorted(wanted))


@cache
def _environment() -> jinja2.Environment:
    """Where templates are found; it keeps them translated, which takes longer than filling them in."""
    return jinja2.Environment(
        loader=jinja2.PackageLoader("codegen.emit"),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=False,
        autoescape=False,
    )


def is_whole(text: str) -> bool:
    """Whether a text is still as it was rendered: the name in it is the digest of all the rest."""
    found = _IDENTITY.search(text)
    return found is not None and _digest(text.replace(found[1], "", 1)) == found[1]


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def runtime_source(names: tuple[str, ...], sizes: tuple[tuple[str, int], ...] = ()) -> str:
    """The runtime files one after the other, without docstrings, imports and what concerns only sizes that are zero."""
    return "\n\n\n".join(
        _specialised(name, tuple((size, number) for size, number in sizes if size in _runtime_file(name)[0]))
        for name in names
    )


@lru_cache(maxsize=1000)
def _specialised(name: str, sizes: tuple[tuple[str, int], ...]) -> str:
    """One of them; sizes are those that it names, so that most problems have most files in common."""
    text, tree = _runtime_file(name)
    docstring = ast.get_docstring(tree, clean=True) or ""
    head = max((node.end_lineno or 0 for node in tree.body if _is_head(node)), default=0)
    body = specialise("\n".join(text.splitlines()[head:]), dict(sizes)).strip()
    comment = "\n".join(f"# {line}".rstrip() for line in docstring.splitlines())
    return f"{comment}\n\n\n{body}" if body.startswith(("@", "def", "class")) else f"{comment}\n\n{body}"


def numba_names(names: tuple[str, ...]) -> list[str]:
    """What a module imports of numba: `njit`, and what else its runtime files import."""
    found = {alias.name for node in _imports(names) if node.module == "numba" for alias in node.names}
    return sorted({"njit"} | found)


def standard_imports(names: tuple[str, ...]) -> list[str]:
    """What runtime files import from the standard library, beside what every module does."""
    every = ("contextlib", "typing")
    found: dict[str, set[str]] = {}
    for node in _imports(names):
        if node.module in sys.stdlib_module_names and node.module not in every:
            found.setdefault(node.module, set()).update(ast.unparse(alias) for alias in node.names)
    return [f"from {module} import {', '.join(sorted(found[module]))}" for module in sorted(found)]


def _imports(names: tuple[str, ...]) -> Iterator[ast.ImportFrom]:
    """The lines `from ... import ...` of runtime files."""
    for name in names:
        yield from (node for node in _runtime_file(name)[1].body if isinstance(node, ast.ImportFrom))


@cache
def _runtime_file(name: str) -> tuple[str, ast.Module]:
    """The text of a runtime file, and what it means."""
    text = runtime_files()[name].read_text(encoding="utf-8")
    return text, ast.parse(text)


@cache
def runtime_files() -> dict[str, Traversable]:
    """The files of `codegen/runtime` by name, which is the same in no two of its folders."""
    root = resources.files("codegen.runtime")
    folders = [root, *(entry for entry in root.iterdir() if entry.is_dir())]
    files = [file for folder in folders for file in folder.iterdir() if file.name.endswith(".py")]
    return {file.name.removesuffix(".py"): file for file in files}


def _is_head(node: ast.stmt) -> bool:
    """Whether a statement is an import or the docstring of the file, which a module does not repeat."""
    return isinstance(node, (ast.Import, ast.ImportFrom)) or (
        isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
    )


def write(path: Path, text: str) -> bool:
    """Write a file atomically if its text differs; return whether it was written.

    A reader sees the old file or the new one, and a killed build leaves the old one. Raises FileError when the file
    system refuses.
    """
    try:
        if path.is_file() and path.read_bytes() == text.encode():
            return False
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise refused(error, path) from error
    write_text(path, text)
    return True


def _in_docstring(text: str) -> str:
    """Text as it has to be written between triple quotes."""
    return text.replace("\\", "\\\\").replace('"', '\\"')


def _tidy(text: str) -> str:
    """Strip trailing blanks, allow two empty lines at most, and end with one newline."""
    text = "\n".join(line.rstrip() for line in text.splitlines())
    return re.sub(r"\n{4,}", "\n\n\n", text).strip("\n") + "\n"
