"""Task -> Program: which expressions are stationary or vanish on every interval, and the layout of the unknowns."""

from __future__ import annotations

from codegen import schemes
from codegen.errors import ArgumentError
from codegen.model import Model
from codegen.schemes import DiscreteLagrangian, OneStep
from codegen.transcribe import control, simulate
from codegen.transcribe.program import ControlProgram, StepProgram

DEFAULT_SCHEME = "midpoint"


def transcribe(
    model: Model, scheme: str | None = None, method: str | None = None, controls: str = "interval"
) -> ControlProgram | StepProgram:
    """Transcribe a model by the named scheme and method; None stands for the default.

    Raises ArgumentError for a method that the task does not have, SchemeError for a scheme that does not exist.
    """
    method = method or _default_method(model, scheme)
    if method not in schemes.METHODS:
        raise ArgumentError(
            f"method {method!r} does not exist for task {model.task}", f"use {' or '.join(schemes.METHODS)}"
        )
    found = schemes.find(scheme or DEFAULT_SCHEME, method)
    if model.task == "simulate":
        if controls != "interval":
            raise ArgumentError("a simulation has no controls", "leave --controls out")
        return simulate.simulate(model, found, method)
    if isinstance(found, DiscreteLagrangian):
        return control.variational(model, found, controls == "nodal")
    assert isinstance(found, OneStep)
    return control.hamiltonian(model, found, controls == "nodal")


def _default_method(model: Model, scheme: str | None) -> str:
    """Variational for control; for a simulation the side on which it is written, if that has the scheme."""
    on_lagrangian_side = model.task == "control" or model.form == "lagrangian"
    preferred = "variational" if on_lagrangian_side else "hamiltonian"
    if scheme is None or scheme in schemes.METHODS[preferred] or (preferred, scheme) in schemes.ALIASES:
        return preferred
    others = [method for method, names in schemes.METHODS.items() if scheme in names]
    return others[0] if others and model.task == "simulate" else preferred
