"""What can be built from a problem file, and what is known of its solution in closed form; needs sympy."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from codegen.discretise import schemes
from codegen.discretise.model.definitions import Model
from codegen.discretise.model.from_problem import load_problem
from codegen.discretise.particles import PARTICLE_SCHEMES
from codegen.discretise.transcribe import methods_for
from codegen.errors import CodegenError


def survey(path: Path, arguments: Mapping[str, str] | None = None) -> dict[str, Any]:
    """Task, form, coordinates, numbers of bodies and phases, and the methods and schemes that may apply.

    A scheme is a row (method, name, order, whether it is symplectic); the problem's default comes first. Whether a
    scheme does apply is found when it is built. Plain values, so that the answer can be stored as JSON. Raises what
    the problem file raises.
    """
    model = load_problem(path, dict(arguments or {}))
    rows = _rows(model)
    found = {"task": model.task, "schemes": [[m, s.name, s.order, s.symplectic] for m, s in rows]}
    if isinstance(model, Model):
        return {**found, "form": model.form, "phases": len(model.phases)}
    return {**found, "form": "particles", "phases": 0}


def exact_cost(path: Path, arguments: Mapping[str, str] | None = None) -> float | None:
    """The optimal cost of a control problem whose maximum principle is solved in closed form, else None."""
    from codegen.evidence.analysis.maximum_principle import exact_optimum

    model = load_problem(path, dict(arguments or {}))
    if not isinstance(model, Model) or model.task != "control":
        return None
    try:
        optimum = exact_optimum(model)
    except CodegenError:  # such as bounds, or controls that the maximum principle does not determine
        return None
    return None if optimum is None else optimum.cost_at()


def _rows(model: Any) -> list[tuple[str, schemes.Scheme]]:
    if isinstance(model, Model):
        methods = methods_for(model)
        rows = [(method, scheme) for method in methods for scheme in schemes.of_method(method)]
    else:
        methods = ("stepping",) if model.connects else ("hamiltonian",)
        rows = [(method, scheme) for method in methods for scheme in PARTICLE_SCHEMES.values() if not scheme.adaptive]
    return sorted(rows, key=lambda row: (row[0] != methods[0], row[1].name != "midpoint"))
