"""The generated solver of registrations: where its problem is found, and how it is built, compiled and kept.

The problem file is in `problems/` of a checkout, and beside this file where the package is installed from a wheel. The
module that is derived from it goes to the build cache ($CODEGEN_CACHE_DIR, or a folder in the user's cache directory),
and its machine code beside it, so that only the first registration on a machine has to wait for either.
"""

from __future__ import annotations

import sys
from functools import cache
from pathlib import Path

from codegen.errors import ModuleError, SchemeError
from codegen.loading import load
from codegen.registration.flow import FlowModule, require_tracers

PROBLEM = "image_registration.py"
DEFAULT_SCHEME = "rk4"


def arguments_of(dimension: int) -> dict[str, str]:
    """The problem's arguments for pictures, in two dimensions, or volumes, in three."""
    return {"passive": "True"} if dimension == 2 else {"passive": "True", "dimension": str(dimension)}


def problem_file() -> Path:
    """The file of the problem whose module registers images; ModuleError when it is missing."""
    here = Path(__file__).parent
    for candidate in (here / "problem" / PROBLEM, here.parents[1] / "problems" / PROBLEM):
        if candidate.is_file():
            return candidate
    raise ModuleError(f"{PROBLEM} is missing from the installation", "install the package again")


def is_compiled(scheme: str = DEFAULT_SCHEME, dimension: int = 2) -> bool:
    """Whether the module of a scheme and its machine code are on disk, so that nobody has to wait for them."""
    from codegen.cache import stored
    from codegen.compiler import build
    from codegen.machine_code.parts import has_machine_code

    if not stored(problem_file(), arguments_of(dimension), scheme=scheme).is_file():
        return False
    return has_machine_code(load(build(problem_file(), arguments_of(dimension), scheme=scheme).path))


@cache
def registration_module(scheme: str = DEFAULT_SCHEME, dimension: int = 2) -> FlowModule:
    """The generated module of a scheme, derived and compiled when it is needed for the first time on a machine.

    That is announced on stderr. Raises SchemeError for a scheme without fixed steps.
    """
    from codegen.compiler import build
    from codegen.machine_code.compilation import compile_all
    from codegen.machine_code.parts import has_machine_code
    from codegen.machine_code.processes import compilers

    made = build(problem_file(), arguments_of(dimension), scheme=scheme)
    module = require_tracers(load(made.path))
    if module.metadata.adaptive:
        raise SchemeError(f"scheme {scheme} chooses its own steps and carries no points", "use midpoint or rk4")
    if not has_machine_code(module):
        print("codegen: compiling the solver of registrations, once on this machine ...", file=sys.stderr)
        with compilers() as processes:
            processes.compile(made.path)
    compile_all(module)  # reads machine code, or makes what is missing, before anything is timed
    return module
