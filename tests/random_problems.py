"""Control problems made of features at random, small enough to be run uncompiled."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from hypothesis import strategies as st
from sympy import Eq, cos, sin

from codegen import Control, Phases, body_number, control, coordinate, free_parameter, parameters, states, time

VARIATIONAL = ["midpoint", "trapezoidal", "gauss-4"]
HAMILTONIAN = ["midpoint", "symplectic-euler", "stormer-verlet", "explicit-euler", "rk4"]
FIRST_ORDER = ["midpoint", "trapezoidal", "implicit-euler", "gauss-4"]

Drawn = tuple[Control | Phases, dict[str, str]]


@st.composite
def single_problems(draw: Callable[..., Any]) -> Drawn:
    """A pendulum that is pushed, with the choices of a build."""
    has = lambda: draw(st.booleans())  # noqa: E731
    u, t, (k,) = control("u"), time(), parameters(k=0.7)
    T = free_parameter("T", 2, lower=0.1) if has() else 2
    a = free_parameter("a", 0.5) if has() else 0
    bodies = draw(st.sampled_from([1, 1, 2]))
    number = body_number() if bodies > 1 else 0
    choices = draw(_choices(["nodal", "interval"]))
    q, v = states("q v") if choices["method"] == "one-step" else coordinate("q")
    push = u * (cos(q) if has() else 1) + (sin(t) if has() else 0)
    motion = _motion(choices, q, v, push + a, k)
    given: dict[str, Any] = {"cost": u**2 * (1 + (q**2 if has() else 0)) + q**2 / 3 + a**2}
    if T != 2 or has():
        given["terminal_cost"] = T + (q - 1) ** 2
    given |= draw(
        st.sampled_from(
            [
                {"start": {q: number / 10, v: 0}, "end": {q: 1, v: 0}},
                {"start": {q: 0, v: 0}, "end": {q: a, v: 0}},
                {"start": {q: 0, v: 0}},
                {"periodic": [q, v]},
                {"periodic": {q: 1}, "start": {v: 0.2}},
                {"start": {q: 0.2}, "end_conditions": [Eq(q**2 + v**2, 1)]},
            ]
        )
    )
    if bodies > 1 and "end" not in given and "end_conditions" not in given:
        given["end_conditions"] = [Eq(q.of(0) - q.of(1), 0.5)]
    given["bounds"] = draw(st.sampled_from([{}, {}, {u: (-2, 2)}, {q: (-3, 3)}]))
    given["path"] = draw(st.sampled_from([[], [], [q + u / 2 <= 3], [v <= 2.5]]))
    guess = {q: 0.3 + 0.2 * t + 0.1 * number}
    return Control(**motion, **given, duration=T, bodies=bodies, guess=guess, steps=6), choices


@st.composite
def phase_problems(draw: Callable[..., Any]) -> Drawn:
    """The same in two or three phases, with jumps."""
    has = lambda: draw(st.booleans())  # noqa: E731
    u, t, (k,) = control("u"), time(), parameters(k=0.7)
    choices = draw(_choices(["interval"]))
    q, v = states("q v") if choices["method"] == "one-step" else coordinate("q")
    count = draw(st.integers(2, 3))
    phases = []
    for i in range(count):
        T = free_parameter(f"T{i + 1}", 1, lower=0.1) if has() else 1
        push = u * (cos(q) if has() else 1) + (sin(t) if has() else 0)
        motion = _motion(choices, q, v, push, k * (i + 1))
        given: dict[str, Any] = {"cost": u**2 * (i + 1) + (u**2 * q**2 if has() else 0), "terminal_cost": T}
        if i == 0:
            given["start"] = {q: 0.2, v: 0} if has() else {q: 0.2}
        given |= draw(st.sampled_from([{}, {"end": {q: 0.5}}, {"end_conditions": [Eq(q + v / 3, 0.5)]}]))
        given["bounds"] = {u: (-2, 2)} if has() else {}
        given["path"] = [q + u / 2 <= 3] if has() else []
        phases.append(Control(**motion, **given, duration=T, guess={q: 0.3 + 0.2 * t}, steps=3))
    jumps = [draw(st.sampled_from([{}, {v: -v / 2}, {q: q + 0.1, v: v + q / 3}])) for _ in range(count - 1)]
    return Phases(*phases, jumps=jumps), choices


@st.composite
def _choices(draw: Callable[..., Any], controls: list[str]) -> dict[str, str]:
    """Method, scheme and where controls live; one-step means a system that is not mechanical."""
    method = draw(st.sampled_from(["variational", "hamiltonian", "one-step"]))
    schemes = {"variational": VARIATIONAL, "hamiltonian": HAMILTONIAN, "one-step": FIRST_ORDER}[method]
    places = controls if method == "variational" else ["interval"]
    scheme = draw(st.sampled_from(schemes))
    place = draw(st.sampled_from(places)) if scheme != "gauss-4" else "interval"
    return {"method": method, "scheme": scheme, "controls": place}


def _motion(choices: dict[str, str], q: Any, v: Any, push: Any, k: Any) -> dict[str, Any]:
    """What says how the system moves."""
    if choices["method"] == "one-step":
        return {"dynamics": {q: v, v: push - k * sin(q) - v / 5}}
    return {"lagrangian": v**2 / 2 * (1 + cos(q) / 3) + k * cos(q), "force": {q: push - v / 5}}
