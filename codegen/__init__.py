"""Discrete mechanics and optimal control: problems in sympy are converted to numba solvers, and solved."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

__version__ = "0.3.0.dev0"

_MODULES = {
    **dict.fromkeys(["Control", "Event", "Phases", "Simulate", "Waypoint"], "codegen.problem.problem"),
    **dict.fromkeys(
        "body_number canonical_pair canonical_pairs control controls coordinate coordinates each_body free_parameter "
        "parameter parameters state states time".split(),
        "codegen.problem.symbols",
    ),
    **dict.fromkeys(["Connect", "Pairwise", "particle", "particles"], "codegen.problem.particles"),
    **dict.fromkeys(["attitude", "direction", "pose", "rotation"], "codegen.problem.rotations"),
    **dict.fromkeys(["Points"], "codegen.problem.points"),
    **dict.fromkeys(["Measurements", "Table", "Trajectory"], "codegen.problem.tables"),
    **dict.fromkeys(["together"], "codegen.problem.bodies"),
    **dict.fromkeys(["build"], "codegen.solving.compiler"),
    **dict.fromkeys(["CodegenError"], "codegen.errors"),
    **dict.fromkeys(["Controller"], "codegen.mpc.controller"),
    **dict.fromkeys(["close_loop"], "codegen.mpc.closed_loop"),
    **dict.fromkeys(["load"], "codegen.solving.loading"),
    **dict.fromkeys(["Solver", "compile"], "codegen.solver"),
    **dict.fromkeys(["solve"], "codegen.solving.api"),
    **dict.fromkeys(["Solutions"], "codegen.batch.optima"),
    **dict.fromkeys(["Motions"], "codegen.batch.motions"),
    **dict.fromkeys(["solve_many"], "codegen.batch.many"),
    **dict.fromkeys(["sweep"], "codegen.batch.sweep"),
}

__all__ = [
    "CodegenError",
    "Connect",
    "Control",
    "Controller",
    "Event",
    "Measurements",
    "Motions",
    "Pairwise",
    "Phases",
    "Points",
    "Simulate",
    "Solutions",
    "Solver",
    "Table",
    "Trajectory",
    "Waypoint",
    "attitude",
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
    "direction",
    "each_body",
    "free_parameter",
    "load",
    "parameter",
    "parameters",
    "particle",
    "particles",
    "pose",
    "rotation",
    "solve",
    "solve_many",
    "state",
    "states",
    "sweep",
    "time",
    "together",
]

if TYPE_CHECKING:
    from codegen.batch.many import solve_many
    from codegen.batch.motions import Motions
    from codegen.batch.optima import Solutions
    from codegen.batch.sweep import sweep
    from codegen.errors import CodegenError
    from codegen.mpc.closed_loop import close_loop
    from codegen.mpc.controller import Controller
    from codegen.problem.bodies import together
    from codegen.problem.particles import Connect, Pairwise, particle, particles
    from codegen.problem.points import Points
    from codegen.problem.problem import Control, Event, Phases, Simulate, Waypoint
    from codegen.problem.rotations import attitude, direction, pose, rotation
    from codegen.problem.symbols import (
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
    from codegen.problem.tables import Measurements, Table, Trajectory
    from codegen.solver import Solver, compile
    from codegen.solving.api import solve
    from codegen.solving.compiler import build
    from codegen.solving.loading import load


def __getattr__(name: str) -> object:
    # Names are imported on first use, so that `codegen --help` and generated modules do not wait for sympy.
    if name not in _MODULES:
        raise AttributeError(f"module 'codegen' has no attribute {name!r}")
    return getattr(import_module(_MODULES[name]), name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
