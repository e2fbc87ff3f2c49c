"""The problems of the gallery as objects: what their files return."""

from pathlib import Path
from typing import Any

from conftest import PROBLEMS

from codegen.problem.points import beside
from codegen.problem.sources import ProblemObject, source_of, written_problem

FILES = [*sorted(PROBLEMS.glob("*.py")), *sorted((PROBLEMS / "published").glob("*.py"))]
"""Every problem file of the gallery."""


def object_of(file: Path, **arguments: str) -> ProblemObject:
    """What a problem file returns, as an object of the same name and title; its data lie beside the file."""
    title, problem, _ = written_problem(file, arguments)
    with beside(file.parent):
        source = source_of(problem, file.stem, title)
    assert isinstance(source, ProblemObject)
    return source


def control(**changes: Any) -> Any:
    """A small problem, made anew with symbols of its own."""
    import codegen

    x, v = codegen.coordinate("x")
    u = codegen.control("u")
    (m,) = codegen.parameters(m=changes.pop("m", 2.0))
    given: dict[str, Any] = {
        "lagrangian": m * v**2 / 2, "force": {x: u}, "cost": u**2, "duration": 1, "start": {x: 0, v: 0},
        "end": {x: 1, v: 0}, "steps": 4,
    }  # fmt: skip
    return codegen.Control(**{**given, **{name: change(x, v, u, m) for name, change in changes.items()}})


def unit_mass(form: str) -> tuple[Any, Any, Any, dict[str, Any]]:
    """Position, velocity and force of a unit mass, with the arguments of its motion in a form."""
    import codegen

    u = codegen.control("u")
    if form == "dynamics":
        x, v = codegen.states("x v")
        return x, v, u, {"dynamics": {x: v, v: u}}
    if form == "hamiltonian":
        x, v = codegen.canonical_pair("x", "v")
        return x, v, u, {"hamiltonian": v**2 / 2, "force": {x: u}}
    x, v = codegen.coordinate("x")
    return x, v, u, {"lagrangian": v**2 / 2, "force": {x: u}}
