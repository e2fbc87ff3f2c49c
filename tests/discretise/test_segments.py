"""What a problem with values of the past becomes: segments, histories, guesses, notes, errors, and its check."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from conftest import PROBLEMS
from interpreted import text_of, without_compilation
from sympy import cos

from codegen import Control, control, coordinate, parameters, state, states, time
from codegen.discretise.model.from_problem import normalise
from codegen.discretise.schemes import find
from codegen.discretise.transcribe import transcribe
from codegen.emit.naming import Choices
from codegen.errors import ArgumentError, BoundaryError
from codegen.evidence.checks import CHECKS, apply
from codegen.evidence.checks.base import Context
from codegen.show.equations import equations
from codegen.solving.results.output import notes
from codegen.solving.results.segments import segments_of


def test_guesses_are_functions_of_the_time_of_the_whole_motion():
    t, x, u = time(), state("x"), control("u")
    problem = Control(
        dynamics={x: x.delayed(0.5) - u}, cost=x**2 + u**2, duration=2, history={x: 1}, guess={x: cos(t), u: t}
    )
    module = without_compilation(text_of(problem))
    grid = module.make_grid(8)
    _, q, _, u_, _ = module.unpack(grid, module.initial_guess(grid))
    segments = segments_of(module.metadata)
    states_ = segments.in_order(q, segments.columns(module.metadata.coordinates)[1], at_nodes=True)
    np.testing.assert_allclose(states_[1:, 0], np.cos(np.linspace(0, 2, 33))[1:], atol=1e-14)
    chosen = segments.in_order(u_, segments.columns(module.metadata.control_names)[1], at_nodes=False)
    np.testing.assert_allclose(chosen[:, 0], (np.arange(32) + 0.5) / 16, atol=1e-14)


def test_histories_say_how_a_motion_starts_unless_the_author_does():
    t, (q, dq), u = time(), coordinate("q"), control("u")
    sound = {"lagrangian": dq**2 / 2, "force": {q: u - q.delayed(1)}, "cost": u**2, "duration": 2}
    whole = normalise(Control(**sound, history={q: cos(t) + t})).authored
    assert (whole.start.positions, whole.start.rates) == ((1,), (1,))
    jumping = normalise(Control(**sound, history={q: cos(t) + t}, start={q: 3, dq: 0})).authored
    assert (jumping.start.positions, jumping.start.rates) == ((3,), (0,))
    free = normalise(Control(**sound, history={q: 1}, start_conditions=[q >= 2, dq <= 1])).authored
    assert (free.start.positions, free.start.rates) == ((None,), (None,))


def test_a_jump_from_the_history_is_a_note():
    x, u = state("x"), control("u")
    sound = {"dynamics": {x: x.delayed(0.5) - u}, "cost": x**2 + u**2, "duration": 1, "history": {x: 1}}
    module = without_compilation(text_of(Control(**sound, start={x: 2})))
    assert notes(module.metadata) == ["x starts at 2, where its history ends at 1: its values of the past jump there"]
    assert notes(without_compilation(text_of(Control(**sound))).metadata) == []


def test_delays_may_be_parts_of_the_duration_that_parameters_give():
    x, u = state("x"), control("u")
    (tau,) = parameters(tau=0.25)
    problem = Control(
        dynamics={x: x.delayed(2 * tau) - u}, cost=x**2 + u**2, duration=6 * tau, history={x: 1}, steps=20
    )
    model = normalise(problem)
    assert (model.segments.number, model.segments.steps_back, model.steps) == (3, (1,), 7)
    assert model.joined == tuple(zip(model.coordinates, model.coordinates[1:], strict=False))
    assert x.delayed(tau).delayed(tau) is x.delayed(2 * tau)


def test_problems_are_shown_as_their_author_wrote_them():
    text = equations(PROBLEMS / "delayed_oscillator.py")
    assert "f_q = -k⋅q(t - τ) + u" in text
    assert "5 segments of length tau run side by side" in text
    step = equations(PROBLEMS / "published" / "delayed_feedback.py", scheme="gauss-4")
    assert "x⁽¹⁾ₖ(t - 1/2)" in step
    for shown, of_segment in ((text, "q₂"), (step, "x⁽¹⁾₂")):
        equations_, _, layout = shown.partition("Layout of the unknowns")
        assert of_segment in layout
        assert of_segment not in equations_


def test_modules_say_how_the_motion_was_cut():
    x, u = state("x"), control("u")
    problem = Control(dynamics={x: x.delayed(0.5) - u}, cost=u**2, duration=2, history={x: cos(time())})
    text = " ".join(text_of(problem).split())
    assert "The motion of duration 2 is cut into 4 segments that run side by side" in text
    assert "This is the method of steps for x(t - 1/2)." in text
    assert "x = cos(t) before t = 0" in text


def test_errors_name_quantities_as_their_author_does():
    x, u = state("x"), control("u")
    sound = {"dynamics": {x: x.delayed(0.5) - u}, "cost": u**2, "duration": 2, "history": {x: 1}}
    with pytest.raises(BoundaryError, match="end of x is 2, above its upper bound 1"):
        normalise(Control(**sound, end={x: 2}, bounds={x: (0, 1)}))
    with pytest.raises(ArgumentError, match="controls at nodes beside delays"):
        transcribe(normalise(Control(**sound)), controls="nodal")


class TestCheck:
    def context(self, scheme: str = "midpoint", **changes) -> Context:
        q, v, u = *states("q v"), control("u")
        problem = Control(
            dynamics={q: v, v: u - q.delayed(0.5)}, cost=q**2 + u**2, duration=1.5, history={q: 1, v: 0}, steps=12
        )
        model, choices = normalise(problem), Choices(scheme=scheme)
        program = transcribe(model, scheme)
        module = without_compilation(text_of(problem, scheme=scheme))
        return Context(choices, model, program, find(program.scheme, program.method), module)

    @pytest.mark.slow
    def test_delayed_equations_hold(self):
        (finding,) = CHECKS["delays"].findings(self.context("gauss-4"))
        assert finding.passed, finding.detail
        assert "order 4.0" in finding.detail

    def test_another_delay_is_found_out(self):
        context = self.context()
        whole = context.model.authored
        (delay,) = whole.delays
        other = replace(whole, delays=(replace(delay, lag=delay.lag / 2),))
        segments = replace(context.model.segments, whole=other)
        damaged = replace(context, model=replace(context.model, segments=segments))
        (finding,) = apply("delays", damaged)
        assert not finding.passed
