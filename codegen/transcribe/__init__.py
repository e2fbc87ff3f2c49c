"""Task -> Program: which expressions are stationary or vanish on every interval, and the layout of the unknowns."""

from __future__ import annotations

from typing import overload

from codegen import schemes
from codegen.errors import ArgumentError, SchemeError
from codegen.model import Model
from codegen.model.pairwise import PairwiseModel
from codegen.transcribe import connect, one_step, phases, simulate, variational
from codegen.transcribe.assembly import in_scaled_time
from codegen.transcribe.connect import PairwiseProgram
from codegen.transcribe.dependent import without_dependent_values
from codegen.transcribe.program import ControlProgram, StepProgram

DEFAULT_SCHEME = "midpoint"
_SYSTEMS = {"lagrangian": "a Lagrangian", "hamiltonian": "a Hamiltonian", "first-order": "a first-order system"}
MOST_PARTS = 6
"""Steps of a composition that a control problem has on an interval at most."""


@overload
def transcribe(
    model: Model, scheme: str | None = None, method: str | None = None, controls: str = "interval"
) -> ControlProgram | StepProgram: ...


@overload
def transcribe(
    model: PairwiseModel, scheme: str | None = None, method: str | None = None, controls: str = "interval"
) -> PairwiseProgram: ...


def transcribe(
    model: Model | PairwiseModel, scheme: str | None = None, method: str | None = None, controls: str = "interval"
) -> ControlProgram | StepProgram | PairwiseProgram:
    """Transcribe a model by the named scheme and method; None stands for the default.

    Raises ArgumentError for a method that the task does not have, SchemeError for a scheme that does not exist.
    """
    if isinstance(model, PairwiseModel):
        if controls != "interval":
            raise ArgumentError("particles have no controls", "leave --controls out")
        return connect.pairwise(model, scheme, method)
    method = method or _default_method(model, scheme)
    _require_method(model, method)
    found = schemes.find(scheme or DEFAULT_SCHEME, method)
    if model.task == "simulate":
        if controls != "interval":
            raise ArgumentError("a simulation has no controls", "leave --controls out")
        return simulate.simulate(model, found, method)
    if model.phases:
        if controls != "interval":
            raise ArgumentError("a problem of several phases has its controls on intervals", "leave --controls out")
        return phases.chained(model, lambda phase: _controlled(phase, found, method, False))
    return without_dependent_values(in_scaled_time(_controlled(model, found, method, controls == "nodal")))


def _controlled(model: Model, scheme: schemes.Scheme, method: str, nodal_controls: bool) -> ControlProgram:
    if scheme.variational:
        return variational.variational(model, scheme, nodal_controls)
    _require_short(scheme)
    if method == schemes.FIRST_ORDER:
        return one_step.first_order(model, scheme, nodal_controls)
    return one_step.hamiltonian(model, scheme, nodal_controls)


def _require_short(scheme: schemes.Scheme) -> None:
    """Refuse compositions that a control problem would have to write out over every interval."""
    if len(scheme.parts) > MOST_PARTS:
        raise SchemeError(
            f"scheme {scheme.name!r} has {len(scheme.parts)} steps, each with unknowns on every interval of a "
            "control problem",
            f"use gauss-4 or gauss-6, or a composition of at most {MOST_PARTS} steps such as suzuki-4",
        )


def _require_method(model: Model, method: str) -> None:
    """Refuse a method that does not exist, or that belongs to the other kind of dynamics."""
    usable = (schemes.FIRST_ORDER,) if model.form == "first-order" else tuple(schemes.METHODS)
    if method in usable:
        return
    if method in (schemes.FIRST_ORDER, *schemes.METHODS):
        needs = _SYSTEMS["first-order"] if method == schemes.FIRST_ORDER else "a Lagrangian or a Hamiltonian"
        finding = f"method {method!r} needs {needs}, and the problem gives {_SYSTEMS[model.form]}"
        raise ArgumentError(finding, f"use {' or '.join(usable)}")
    raise ArgumentError(f"method {method!r} does not exist for task {model.task}", f"use {' or '.join(usable)}")


def _default_method(model: Model, scheme: str | None) -> str:
    """Variational for control, one-step where there is no other; for a simulation the side on which it is written."""
    if model.form == "first-order":
        return schemes.FIRST_ORDER
    on_lagrangian_side = model.task == "control" or model.form == "lagrangian"
    preferred = "variational" if on_lagrangian_side else "hamiltonian"
    base = (scheme or "").rpartition("-of-")[2]
    if scheme is None or base in schemes.METHODS[preferred] or (preferred, base) in schemes.ALIASES:
        return preferred
    others = [method for method, names in schemes.METHODS.items() if base in names or (method, base) in schemes.ALIASES]
    return others[0] if others and model.task == "simulate" else preferred
