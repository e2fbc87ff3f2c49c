"""What is measured of a problem that is simulated: errors of every scheme against steps and run time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from codegen.errors import CodegenError
from codegen.interfaces import SimulateModule, is_simulation
from codegen.report.building import Variant, Workshop
from codegen.report.extent import Extent
from codegen.report.measure.convergence import Spans, order_values, spans_of
from codegen.report.measure.optima import well_timed
from codegen.report.measure.orders import is_exhausted
from codegen.report.measure.reference_motion import component_sizes, conserved, reference_motion
from codegen.report.store import Case, Store, Values

CHECKPOINTS = 20
"""Intervals between the times at which trajectories are compared."""
BELOW = 1
"""The coarsest ladder step is the problem's own number of steps halved so often."""


def errors_of(problem: Path) -> str:
    """The section of the store that holds the errors of all schemes."""
    return f"{problem.stem}: errors"


def references_of(problem: Path) -> str:
    """The section of the store that holds the reference motion."""
    return f"{problem.stem}: reference"


def orders_of(problem: Path) -> str:
    """The section of the store that holds the measurements of orders."""
    return f"{problem.stem}: orders"


def case_name(variant: Variant, steps: int) -> str:
    """The name of a case."""
    return f"{variant.label}; N {steps}"


def ladder(own_steps: int, doublings: int) -> list[int]:
    """Numbers of steps: multiples of the number of checkpoints, doubled so often."""
    first = CHECKPOINTS * max(1, round(own_steps / 2**BELOW / CHECKPOINTS))
    return [first * 2**k for k in range(doublings + 1)]


def cases(problem: Path, variants: Sequence[Variant], workshop: Workshop, extent: Extent) -> Iterator[Case]:
    """The reference, then every scheme with ever more steps, until one takes too long or rounding has taken over."""
    store, built = workshop.store, workshop.built(variants)
    euler = [v for v in built if v.scheme == "explicit-euler"]
    if not euler:
        return
    yield Case(references_of(problem), "motion", lambda: _reference(_simulation(workshop, euler[0])))
    spans = _spans(_simulation(workshop, euler[0]), store, problem)
    for variant in built:
        yield Case(
            orders_of(problem),
            variant.label,
            lambda v=variant: order_values(_simulation(workshop, v), spans, extent.limit),  # type: ignore[misc]
        )
        own_steps = int(workshop.module(variant).metadata.steps)
        rungs = ladder(own_steps, extent.simulation_doublings)
        for steps in rungs:
            name = case_name(variant, steps)
            yield Case(
                errors_of(problem),
                name,
                lambda v=variant, n=steps: _errors(  # type: ignore[misc]
                    _simulation(workshop, v), _simulation(workshop, euler[0]), store, problem, n, extent.repeat
                ),
            )
            values = store.get(errors_of(problem), name)
            if values is not None and (values["seconds"] or 0.0) > extent.limit:
                break
            rows = [store.get(errors_of(problem), case_name(variant, n)) or {} for n in rungs if n <= steps]
            if is_exhausted(rungs[: len(rows)], [row.get("trajectory") for row in rows]):
                break


def _simulation(workshop: Workshop, variant: Variant) -> SimulateModule:
    module = workshop.module(variant)
    assert is_simulation(module)
    return module


def _spans(euler: SimulateModule, store: Store, problem: Path) -> Spans:
    """The spans on which orders are measured, each computed when it is first needed."""
    reference = store.get(references_of(problem), "motion")
    assert reference is not None
    return Spans(spans_of(euler, reference["times"], np.array(reference["states"], dtype=float)))


def _reference(module: SimulateModule) -> Values:
    motion = reference_motion(module, CHECKPOINTS)
    return {
        "times": motion.times,
        "states": motion.states,
        "error": motion.error,
        "energy scale": motion.energy_scale,
        "how": motion.how,
        "conserved": list(conserved(module)),
    }


def _errors(
    module: SimulateModule, euler: SimulateModule, store: Store, problem: Path, steps: int, repeat: int
) -> Values:
    """Largest errors at the checkpoints: of the state by component's size, of energy and conserved momenta."""
    reference = store.get(references_of(problem), "motion")
    assert reference is not None
    try:
        result = well_timed(module, "newton", repeat, steps=steps, every=steps // CHECKPOINTS)
    except CodegenError as error:  # such as too little memory
        return {"status": "refused", "message": str(error), "steps": steps, "seconds": None}
    found: dict[str, Any] = {
        "status": result.status, "steps": steps, "seconds": result.seconds_solve, "iterations": result.iterations,
        "residual": result.residual, "order": module.metadata.order,
    }  # fmt: skip
    if not result.solved:
        return found
    states, exact = np.hstack([result.q, result.p]), np.array(reference["states"], dtype=float)
    found["trajectory"] = float((np.abs(states - exact) / component_sizes(exact)).max())
    assert result.energy is not None
    exact_energy = _energies(euler, exact, reference["times"])
    found["energy"] = float(np.abs(result.energy - exact_energy).max()) / reference["energy scale"]
    momenta = conserved(euler)
    drifts = [_drift(momenta[name], states) for name in reference["conserved"]]
    if drifts:
        found["momentum"] = max(drifts)
    return found


def _drift(momentum: Any, states: Any) -> float:
    values = momentum(states)
    half = states.shape[-1] // 2
    return float(np.abs(values - values[0]).max() / (np.abs(states[:, half:]).max() or 1.0))


def _energies(module: SimulateModule, states: Any, times: Any) -> Any:
    parameters = module.make_grid(1).parameters
    return np.array([module.energy(z, t, parameters) for z, t in zip(states, times, strict=True)])
