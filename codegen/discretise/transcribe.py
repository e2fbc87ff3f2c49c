"""From a model to a program: the expressions of one interval, and the layout of the unknowns."""

from __future__ import annotations

from typing import overload

from codegen.discretise import one_step, particles, phases, schemes, simulation, variational
from codegen.discretise.assembly import in_scaled_time
from codegen.discretise.determined_values import without_dependent_values
from codegen.discretise.model.definitions import Model
from codegen.discretise.model.delays import errors_of_the_whole
from codegen.discretise.model.pairwise import PairwiseModel
from codegen.discretise.particles import PairwiseProgram
from codegen.discretise.program import ControlProgram, StepProgram
from codegen.errors import ArgumentError, SchemeError

DEFAULT_SCHEME = "midpoint"
_SYSTEMS = {"lagrangian": "a Lagrangian", "hamiltonian": "a Hamiltonian", "first-order": "a first-order system"}
MOST_PARTS = 16
"""Greatest number of steps of a composition on an interval of a control problem."""


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
    """Return the program of a model for the named scheme and method; None means the default.

    Raises ArgumentError for a method that the task does not have, SchemeError for a scheme that does not exist.
    """
    if isinstance(model, PairwiseModel):
        if controls != "interval":
            raise ArgumentError("particles have no controls", "leave --controls out")
        return particles.pairwise(model, scheme, method)
    method = method or (methods_for(model)[0] if model.task == "control" else method_with(model, scheme))
    usable = methods_for(model)
    if method not in usable and method in (schemes.FIRST_ORDER, *schemes.METHODS):
        needs = _SYSTEMS["first-order"] if method == schemes.FIRST_ORDER else "a Lagrangian or a Hamiltonian"
        if model.linear:
            needs = "canonical pairs" if method == "hamiltonian" else "a kinetic energy"
        given = "a Lagrangian that is linear in the velocities" if model.linear else _SYSTEMS[model.form]
        finding = f"method {method!r} needs {needs}, and the problem gives {given}"
        raise ArgumentError(finding, f"use {' or '.join(usable)}")
    if method not in usable:
        raise ArgumentError(f"method {method!r} does not exist for task {model.task}", f"use {' or '.join(usable)}")
    chosen = schemes.find(scheme or DEFAULT_SCHEME, method, usable)
    if model.task == "simulate":
        if controls != "interval":
            raise ArgumentError("a simulation has no controls", "leave --controls out")
        return simulation.simulate(model, chosen, method)
    if controls == "linear" and model.controls and not chosen.resolves_lines:
        resolving = [each.name for each in schemes.of_method(method) if each.resolves_lines and not each.parts]
        raise SchemeError(
            f"scheme {chosen.name!r} evaluates cost and forces at one time of an interval, and does not determine both "
            "end values of a linear control",
            f"use --scheme {' or '.join(resolving)}, or --controls interval",
        )
    if controls == "nodal" and model.rolling and model.controls and chosen.name == "midpoint":
        raise SchemeError(
            "rolling with nodal controls by the scheme 'midpoint': the means of neighbouring controls do not determine "
            "the controls, the KKT matrix is singular, and searches stall",
            "use --controls interval, which has the same motions, or --scheme trapezoidal",
        )
    if model.contacts and controls != "interval":
        raise ArgumentError("contact forces belong to intervals", "leave --controls out")
    if model.joined and controls in ("linear", "nodal"):
        raise ArgumentError("controls at nodes beside delays", "use --controls interval or stages")
    if model.phases:
        if controls != "interval":
            raise ArgumentError("a problem of several phases has its controls on intervals", "leave --controls out")
        return phases.chained(model, lambda phase: _controlled(phase, chosen, method, "interval"))
    with errors_of_the_whole(model):
        return without_dependent_values(in_scaled_time(_controlled(model, chosen, method, controls)))


def methods_for(model: Model) -> tuple[str, ...]:
    """Return the methods for a model: "variational" comes first, except in simulations of a Hamiltonian."""
    if model.form == "first-order":
        has_pairs = model.linear is not None and model.linear.pairs is not None
        return ("hamiltonian", schemes.FIRST_ORDER) if has_pairs else (schemes.FIRST_ORDER,)
    return tuple(sorted(schemes.METHODS, reverse=model.task == "control" or model.form == "lagrangian"))


def method_with(model: Model, scheme: str | None) -> str:
    """Return the first method that a model can use and that has the scheme, or else the first method."""
    methods = methods_for(model)
    return next((method for method in methods if scheme is None or schemes.is_known(scheme, method)), methods[0])


def _controlled(model: Model, scheme: schemes.Scheme, method: str, controls: str) -> ControlProgram:
    if scheme.variational:
        return variational.variational(model, scheme, controls)
    if len(scheme.parts) > MOST_PARTS:
        raise SchemeError(
            f"scheme {scheme.name!r} has {len(scheme.parts)} steps, each with unknowns on every interval of a "
            "control problem",
            f"use gauss-4 or gauss-6, or a composition of at most {MOST_PARTS} steps such as suzuki-4",
        )
    return one_step.one_step(model, scheme, method, controls)
