"""Linear systems with the numbers of their shape as constants, compiled once for each shape.

The text is the same for all problems of a shape. It is kept in the cache folder, and numba keeps its machine code beside
it. Constants halve the time of a factorisation.
"""

import hashlib
import importlib.util
import os
import sys
from functools import lru_cache
from pathlib import Path

from numba import types

from codegen.runtime.addresses import SYSTEM
from codegen.runtime.kkt.shape import Shape
from codegen.runtime.kkt.system import solve_system
from codegen.runtime.packing import packed_operations, little_optimised

TEXT = '''"""The linear system of Newton's method for problems of one shape, made by codegen; do not edit.

Numbers of unknowns: {fields}.
"""

from numba import cfunc

from codegen.runtime.addresses import SYSTEM
from codegen.runtime.kkt.shape import Shape
from codegen.runtime.kkt.system import solve_system


@cfunc(SYSTEM, cache=True, error_model="numpy")
def system(
    is_new, bodies, steps, inverses, tables, entries, gradient, diagonal, equations, factors, orders, step, is_wanted
):
    """Factor the KKT matrix if it `is_new`, and solve for the step if it `is_wanted`; see `solve_system`."""
    return solve_system(
        Shape({values}), is_new, bodies, steps, inverses, tables, entries, gradient, diagonal, equations, factors,
        orders, step, is_wanted,
    )
'''


def cache_folder():
    """Return the folder of the build cache: $CODEGEN_CACHE_DIR, or one in the user's cache directory."""
    given = os.environ.get("CODEGEN_CACHE_DIR")
    if given:
        return Path(given)
    home = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(home) / "variational-codegen"


def text_of(shape):
    """Return the text of the module with the linear system of a shape."""
    fields = ", ".join(f"{name} {value}" for name, value in zip(Shape._fields, shape, strict=True))
    return TEXT.format(fields=fields, values=", ".join(map(str, shape)))


@lru_cache(maxsize=256)
def system_address(shape):
    """Return the address of the linear system of a shape, which is compiled if it is new to this machine."""
    text = text_of(shape)
    name = f"kkt_{hashlib.sha256((text + sources()).encode()).hexdigest()[:16]}"
    if name not in sys.modules:
        path = cache_folder() / "kkt" / f"{name}.py"
        if not path.is_file() or path.read_text(encoding="utf-8") != text:
            path.parent.mkdir(parents=True, exist_ok=True)
            temporary = path.with_name(f".{name}.{os.getpid()}")
            temporary.write_text(text, encoding="utf-8")
            temporary.replace(path)
        compile_common()
        spec = importlib.util.spec_from_file_location(name, path)
        module = sys.modules[name] = importlib.util.module_from_spec(spec)
        with packed_operations():
            spec.loader.exec_module(module)
    return sys.modules[name].system.address


@lru_cache(maxsize=1)
def compile_common():
    """Compile what the systems of all shapes include, once on a machine.

    It is left to the optimisation of each shape, where all numbers are constants: that is quicker, and makes quicker
    code.
    """
    with little_optimised():
        solve_system.compile((types.NamedUniTuple(types.int64, len(Shape._fields), Shape), *SYSTEM.args))


@lru_cache(maxsize=1)
def sources():
    """Return the texts on which the machine code of a linear system depends."""
    folder = Path(__file__).parent
    files = sorted([*folder.glob("*.py"), folder.parent / "addresses.py", folder.parent / "arrays.py"])
    return "".join(file.read_text(encoding="utf-8") for file in files)
