"""Compiled linear systems: one for each Shape, with its numbers as constants, and one for all shapes.

The source of a specialised system is made from the files of this folder: a constant `shape` replaces the argument.
Problems of equal Shape share the system. The source is kept in the cache folder, next to numba's machine code.
Constants halve the time of a factorisation.

The system for all shapes reads the numbers at run time and needs no compilation for a new Shape. This takes less time
for many small problems, such as tests.
"""

import ast
import hashlib
import importlib.util
import os
import re
import sys
from functools import lru_cache
from pathlib import Path

from codegen.runtime.addresses import SYSTEM, entry_of
from codegen.runtime.kept_code import fingerprint, fresh_folder
from codegen.runtime.kernels import packed_operations
from codegen.runtime.kkt.shape import SHAPE, Shape, place_of
from codegen.runtime.kkt.system import solve_system

FILES = "shape", "symmetric", "stages", "elimination", "system"
PARTS = ("eliminate_body", "forward", "backward", "condense", "recover_condensed")
"""Functions whose intermediate code numba keeps, so that several processes can compile a system."""
HEAD = '''"""The linear system of Newton's method for problems of one shape, made by codegen; do not edit.

Numbers of unknowns: {fields}.
"""

import numpy as np
from numba import carray, njit

from codegen.runtime.addresses import ahead
from codegen.runtime.kkt.shape import Shape
from codegen.runtime.linking import link_inner_functions

shape = Shape({values})
'''
WITHOUT_STAGES = '''
HAS_STAGES = False
eliminate_stages = reduce_right = recover_stages = None


@njit(error_model="numpy")
def stage_views(tables, reals, integers, bodies, body, steps):
    """Return nothing: there are no stages."""
    return None, None
'''
TAIL = '''
link_inner_functions(value for value in list(globals().values()) if hasattr(value, "py_func"))
for part in ({parts}):
    part.enable_caching()


def system(
    is_new, bodies, steps, inverses, tables, entries, gradient, diagonal, equations, factors, orders, step, is_wanted
):
    """Factor the KKT matrix if it `is_new`, and solve for the step if it `is_wanted`; see `solve_system`."""
    return solve_system(
        is_new, bodies, steps, inverses, tables, entries, gradient, diagonal, equations, factors, orders, step,
        is_wanted,
    )
'''


def cache_folder():
    """Return the path of the build cache: $CODEGEN_CACHE_DIR, or a folder in the user's cache directory."""
    folder = os.environ.get("CODEGEN_CACHE_DIR")
    if folder:
        return Path(folder)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "variational-codegen"


def text_of(shape):
    """Return the source of the module with the linear system of a Shape."""
    fields = ", ".join(f"{name} {value}" for name, value in zip(Shape._fields, shape, strict=True))
    head = HEAD.format(fields=fields, values=", ".join(map(str, shape)))
    tail = TAIL.replace("{parts}", ", ".join(PARTS))
    texts = (body_of(name) if name != "stages" or shape.stages else WITHOUT_STAGES for name in FILES)
    return "\n\n".join([head, *texts, tail])


@lru_cache
def body_of(name):
    """Return the statements of the file `name` of this folder, without the arguments `shape`.

    Imports, the module's docstring, the class Shape and functions that only Python calls are left out.
    """
    text = Path(__file__).with_name(f"{name}.py").read_text(encoding="utf-8")
    lines, kept = text.splitlines(), []
    for node in ast.parse(text).body:
        is_docstring = isinstance(node, ast.Expr) and node.col_offset == 0 and not kept
        is_class = isinstance(node, ast.ClassDef)
        if isinstance(node, (ast.Import, ast.ImportFrom)) or is_docstring or is_class:
            continue
        if isinstance(node, ast.FunctionDef) and node.name in ("packed", "factor_sizes", "stage_sizes"):
            continue
        first = min([node.lineno, *(decorator.lineno for decorator in getattr(node, "decorator_list", []))])
        between = "\n\n" if isinstance(node, ast.FunctionDef) else ""
        kept.append(between + "\n".join(lines[first - 1 : node.end_lineno]))
    return without_shape("\n".join(kept))


def without_shape(text):
    """Return the source `text` of functions without the arguments `shape`."""
    return re.sub(r"\(shape\)", "()", re.sub(r"\bshape,\s+", "", text))


@lru_cache(maxsize=256)
def system_module(shape):
    """Return the module with the linear system of a Shape; write it first if the cache has no complete file."""
    name = f"kkt_{hashlib.sha256(f'{shape} {fingerprint()}'.encode()).hexdigest()[:16]}"
    path = cache_folder() / "kkt" / f"{name}.py"
    if not is_whole(path):
        text = text_of(shape)
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_name(f".{name}.{os.getpid()}")
        temporary.write_text(f"# {digest_of(text)}\n{text}", encoding="utf-8")
        temporary.replace(path)
    fresh_folder(str(path))
    spec = importlib.util.spec_from_file_location(name, path)
    module = sys.modules[name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def is_whole(path):
    """Return True if the file is complete: its first line is the digest of the rest."""
    try:
        first, _, text = path.read_text(encoding="utf-8").partition("\n")
    except (OSError, UnicodeDecodeError):
        return False
    return first == f"# {digest_of(text)}"


def digest_of(text):
    """Return the SHA-256 digest of a text, in hexadecimal digits."""
    return hashlib.sha256(text.encode()).hexdigest()


@lru_cache(maxsize=256)
def compiled_system(shape):
    """Return the compiled linear system of a Shape; its attribute `address` is the address for calls."""
    with packed_operations():
        return entry_of(SYSTEM, system_module(shape).system)


def system_address(shape):
    """Return the address of the linear system of a Shape; compile the system if the cache has none."""
    return compiled_system(shape).address


@lru_cache(maxsize=1)
def compiled_any_shape():
    """Return the compiled linear system for all shapes; its attribute `address` is the address for calls."""

    def system(
        is_new, bodies, steps, inverses, tables, entries, gradient, diagonal, equations, factors, orders, step,
        is_wanted,
    ):  # fmt: skip
        """Factor the KKT matrix if `is_new` is 1, and solve for `step` if `is_wanted` is 1; see `solve_system`."""
        p = place_of(tables, SHAPE)
        shape = Shape(
            tables[p], tables[p + 1], tables[p + 2], tables[p + 3], tables[p + 4], tables[p + 5], tables[p + 6],
            tables[p + 7], tables[p + 8], tables[p + 9], tables[p + 10], tables[p + 11], tables[p + 12], tables[p + 13],
        )  # fmt: skip
        return solve_system(
            shape, is_new, bodies, steps, inverses, tables, entries, gradient, diagonal, equations, factors, orders,
            step, is_wanted,
        )  # fmt: skip

    return entry_of(SYSTEM, system)


def any_shape_address():
    """Return the address of the linear system for all shapes."""
    return compiled_any_shape().address
