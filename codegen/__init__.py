"""Derive, emit and solve discrete mechanics: problems in sympy become numba solvers."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.2.0.dev0"

_HOMES = {
    **dict.fromkeys(["Control", "Phases", "Simulate", "Waypoint"], "codegen.author.problem"),
    **dict.fromkeys(
        "body_number canonical_pair canonical_pairs control controls coordinate coordinates each_body free_parameter "
        "parameter parameters state states time".split(),
        "codegen.author.symbols",
    ),
    **dict.fromkeys(["Connect", "Pairwise", "particle", "particles"], "codegen.author.particles"),
    **dict.fromkeys(["Points"], "codegen.author.points"),
    **dict.fromkeys(["Measurements", "Table", "Trajectory"], "codegen.author.tables"),
    **dict.fromkeys(["together"], "codegen.author.bodies"),
    **dict.fromkeys(["build"], "codegen.compiler"),
    **dict.fromkeys(["CodegenError"], "codegen.errors"),
    **dict.fromkeys(["Controller"], "codegen.horizons.controller"),
    **dict.fromkeys(["close_loop"], "codegen.horizons.closed_loop"),
    **dict.fromkeys(["load"], "codegen.loading"),
    **dict.fromkeys(["Solver", "compile"], "codegen.solver"),
    **dict.fromkeys(["solve"], "codegen.solving"),
    **dict.fromkeys(["sweep"], "codegen.sweeping"),
}

__all__ = [
    "CodegenError",
    "Connect",
    "Control",
    "Controller",
    "Measurements",
    "Pairwise",
    "Phases",
    "Points",
    "Simulate",
    "Solver",
    "Table",
    "Trajectory",
    "Waypoint",
    "body_number",
    "build",
    "canonical_pair",
    "canonical_pairs",
    "close_loop",
    "compile",
    "control",
    "controls",
    "coordinate",
    "coordinates",
    "each_body",
    "free_parameter",
    "load",
    "parameter",
    "parameters",
    "particle",
    "particles",
    "solve",
    "state",
    "states",
    "sweep",
    "time",
    "together",
]

if TYPE_CHECKING:
    from codegen.author.bodies import together
    from codegen.author.particles import Connect, Pairwise, particle, particles
    from codegen.author.points import Points
    from codegen.author.problem import Control, Phases, Simulate, Waypoint
    from codegen.author.symbols import (
        body_number,
        canonical_pair,
        canonical_pairs,
        control,
        controls,
        coordinate,
        coordinates,
        each_body,
        free_parameter,
        parameter,
        parameters,
        state,
        states,
        time,
    )
    from codegen.author.tables import Measurements, Table, Trajectory
    from codegen.compiler import build
    from codegen.errors import CodegenError
    from codegen.horizons.closed_loop import close_loop
    from codegen.horizons.controller import Controller
    from codegen.loading import load
    from codegen.solver import Solver, compile
    from codegen.solving import solve
    from codegen.sweeping import sweep


def __getattr__(name: str) -> Any:
    # Imported on first use, so that `codegen --help` and generated modules' users never wait for sympy.
    if name not in _HOMES:
        raise AttributeError(f"module 'codegen' has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)
