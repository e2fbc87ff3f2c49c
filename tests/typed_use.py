"""All of the public API as a person uses it in a file of his own, for `mypy --strict`; tests run parts of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

import codegen
from codegen import (
    CodegenError,
    Connect,
    Control,
    Controller,
    Event,
    Measurements,
    Pairwise,
    Phases,
    Points,
    Simulate,
    Solver,
    Table,
    Trajectory,
    Waypoint,
)
from codegen.drawing import Mass


def double_integrator() -> Control:
    """A cart that is pushed from rest to rest with the least effort."""
    x, v = codegen.coordinate("x")
    u = codegen.control("u")
    m = codegen.parameter("m", 1.0)
    return Control(
        lagrangian=m * v**2 / 2,
        force={x: u},
        cost=u**2,
        duration=1,
        start={x: 0, v: 0},
        end={x: 1, v: 0},
        steps=10,
        bounds={u: (-100, None)},
        drawing=[Mass((x, 0), 0.1)],
    )


def oscillator() -> Simulate:
    """A mass on a spring, by its Hamiltonian."""
    q, p = codegen.canonical_pair("q", "p", unit="m", momentum_unit="kg*m/s")
    k, m = codegen.parameters(k=(1.0, "N/m"), m=(1.0, "kg"))
    turn = Event(p, then="record", direction=-1)
    return Simulate(
        hamiltonian=p**2 / (2 * m) + k * q**2 / 2, duration=1, start={q: 1, p: 0}, events={"turn": turn}, steps=20
    )


def first_order() -> Control:
    """Two states whose duration is free, with a condition on the way."""
    a, b = codegen.states("a b")
    c = codegen.state("c")
    u, w = codegen.controls("u w")
    t = codegen.time()
    duration = codegen.free_parameter("T", 1.0, lower=0.1)
    return Control(
        dynamics={a: b, b: u, c: w + 0 * t},
        cost=u**2 + w**2,
        terminal_cost=duration,
        duration=duration,
        start={a: 0, b: 0, c: 0},
        end={a: 1, b: 0, c: 1},
        waypoints=[Waypoint([a - 0.5])],
    )


def two_bodies() -> Control:
    """Two carts of different mass."""
    (x, y), (vx, vy) = codegen.coordinates("x y")
    u, w = codegen.controls("u w")
    one = Control(lagrangian=vx**2 / 2, force={x: u}, cost=u**2, duration=1, start={x: 0, vx: 0}, end={x: 1, vx: 0})
    other = Control(lagrangian=vy**2, force={y: w}, cost=w**2, duration=1, start={y: 0, vy: 0}, end={y: 1, vy: 0})
    return codegen.together(one, other, path=[x <= y + 5])


def satellite() -> Control:
    """A rigid body that turns, beside a unit vector and an attitude of first-order dynamics."""
    (x, R), (v, omega) = codegen.pose("B")
    S, spin = codegen.rotation("S")
    n, dn = codegen.direction("n")
    assert codegen.attitude("A").shape == R.shape == S.shape
    assert dn.shape == spin.shape == n.shape
    u = codegen.controls("a b c")
    return Control(
        lagrangian=v.dot(v) / 2 + omega.dot(omega) / 2, force={R: u}, cost=u[0] ** 2 + u[1] ** 2, duration=1,
        start={x: (0, 0, 0), v: (0, 0, 0), R: ([0, 0, 1], 0), omega: (0, 0, 0)}, end={R: ([0, 0, 1], 1)},
    )  # fmt: skip


def many_bodies() -> Control:
    """Three carts alike, which start at places of their own."""
    (qs, ps) = codegen.canonical_pairs("q", "p")
    u = codegen.control("u")
    number = codegen.body_number()
    start = {qs[0]: codegen.each_body(0.0, 1.0, 2.0) + number, ps[0]: 0}
    return Control(
        hamiltonian=ps[0] ** 2 / 2, force={qs[0]: u}, cost=u**2, duration=1, start=start, end={qs[0]: 1, ps[0]: 0},
        bodies=3,
    )  # fmt: skip


def two_phases() -> Phases:
    """A push, then another one."""
    x, v = codegen.states("x v")
    u = codegen.control("u")
    first = Control(dynamics={x: v, v: u}, cost=u**2, duration=1, start={x: 0, v: 0})
    second = Control(dynamics={x: v, v: 2 * u}, cost=u**2, duration=1, end={x: 1, v: 0})
    return Phases(first, second, jumps=[{v: 0.5 * v}])


def particles(points: Points) -> Connect:
    """Particles that repel each other on their way to given places."""
    i = codegen.particle("x", "p")
    pair = Pairwise(i, pair_term=lambda one, other: one.p[0] * other.p[0] / (1 + (one.q[0] - other.q[0]) ** 2))
    first, _ = codegen.particles("x", "p")
    assert len(first.q) == 1
    return Connect(hamiltonian=pair, points=points)


def with_data(table: Path, measured: Path, guess: Path) -> Control:
    """Files of numbers in a problem."""
    x, u = codegen.state("x"), codegen.control("u")
    drag = Table(table, inputs="x", output="drag")
    observations = Measurements(measured, values={x: "x"})
    return Control(
        dynamics={x: u - drag(x)}, cost=u**2, duration=1, start={x: 0}, observations=observations,
        guess=Trajectory(guess),
    )  # fmt: skip


def compiled(folder: Path) -> Solver:
    """A solver from an object; a file in place of the object has a name of its own."""
    return codegen.compile(double_integrator(), name="push", title="Push a cart.", scheme="midpoint", out=folder)


def used(solver: Solver) -> Mapping[str, float]:
    """All that a solver does but for sweeps and controllers; quantities are nondimensional."""
    solution = solver.solve(steps=20)
    other = codegen.solve(solver, "newton", warm=solution.unknowns, steps=20)
    assert solution.solved
    assert solution.u is not None
    assert solution.cost is not None
    findings, equations, source = solver.check(), solver.show(), solver.source
    assert findings.passed, [finding.detail for finding in findings.failed]
    assert "Boundary conditions" in equations.text
    assert "align" in equations.latex
    assert source.path.read_text() == source.text == str(source)
    data, frame = solution.to_dataset(), solution.to_frame()
    assert data["q"].dims == ("node", "coordinate")
    assert len(frame) == solution.t.size
    largest: float = float(np.abs(solution.u).max())
    return {**solution.differences(other), "largest": largest, "cost": solution.cost}


def pictured(solver: Solver, folder: Path) -> str:
    """A picture and a film, in a notebook and as files; or why there is no film."""
    solution = solver.solve()
    assert solution.plot(folder / "push.svg").figure.axes
    assert solution.plot(style="paper").text.startswith(solution.title.rstrip("."))
    try:
        solution.animate().save(folder / "push.gif")
    except CodegenError as error:
        return error.remedy
    return ""


def swept_and_controlled(solver: Solver) -> tuple[list[float], list[float]]:
    """Many solves, and a closed loop."""
    data = solver.sweep({"m": [1.0, 2.0]}, workers=1)
    again = codegen.sweep(solver, {"m": [1.0, 2.0]}, workers=1)
    many: codegen.Solutions = codegen.solve_many(solver, {"m": [1.0, 2.0]}, threads=1)
    assert many.solved.all()
    motions: codegen.Motions = codegen.solve_many(replace(oscillator(), events={}), {"m": [1.0, 2.0]}, threads=1)
    assert motions.q.shape[0] == 2
    controller: Controller = solver.controller(steps=10)
    loop = codegen.close_loop(controller, lambda state, inputs, t, h: state, samples=2)
    assert loop.statuses.size
    return data["cost"].values.tolist(), again["cost"].values.tolist()


def built(file: Path) -> float | None:
    """The older way, by a file: the same module, whose solutions are those of the module itself."""
    made = codegen.build(file, {"form": "hamiltonian"}, scheme="stormer-verlet")
    module = codegen.load(made.path)
    return codegen.solve(module).residual
