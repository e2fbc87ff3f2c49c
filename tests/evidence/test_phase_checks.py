"""The checks on problems of several phases, of which uncompiled modules are damaged in turn."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from evidence.conftest import PROBLEMS
from interpreted import Interpreted

from codegen.discretise import schemes, transcribe
from codegen.discretise.model.from_problem import load_problem
from codegen.emit.naming import Choices
from codegen.evidence import checks
from codegen.evidence.checks.base import Context


@pytest.fixture(scope="module")
def contexts(tmp_path_factory) -> dict[str, Context]:
    """Both problems of the gallery, with modules that this file alone may change."""
    made, interpreted = {}, Interpreted(tmp_path_factory.mktemp("phases"), PROBLEMS)
    for name in ("two_stage_rocket", "bouncing_ball"):
        model = load_problem(PROBLEMS / f"{name}.py", {})
        program = transcribe.transcribe(model)
        scheme = schemes.find(program.scheme, program.method)
        made[name] = Context(Choices(), replace(model, steps=8), program, scheme, interpreted(name))
    return made


@pytest.mark.slow
@pytest.mark.parametrize("problem", ["two_stage_rocket", "bouncing_ball"])
def test_all_checks_pass(contexts, problem):
    findings = [finding for name in checks.CHECKS for finding in checks.apply(name, contexts[problem])]
    assert [finding for finding in findings if not finding.passed] == []
    assert {f.check for f in findings if f.applies} >= {"switches", "derivatives", "assembly", "given values"}
    assert len([f for f in findings if f.check == "switches"]) == 2 * (len(contexts[problem].program.phases) - 1)


def failing(name: str, context: Context) -> list[str]:
    return [finding.subject for finding in checks.apply(name, context) if not finding.passed]


@pytest.mark.parametrize("problem", ["two_stage_rocket", "bouncing_ball"])
def test_another_jump_is_found(contexts, problem):
    context = contexts[problem]
    jumps = [[(symbol, 1.01 * value) for symbol, value in jump] for jump in context.model.jumps]
    assert failing("switches", replace(context, model=replace(context.model, jumps=jumps))) == ["switch 1, after it"]


def test_another_condition_before_a_switch_is_found(contexts):
    context = contexts["bouncing_ball"]
    first, second = context.model.phases
    lifted = replace(first, end=replace(first.end, positions=(None, first.end.positions[1] + 0.01)))
    model = replace(context.model, phases=(lifted, second))
    assert failing("switches", replace(context, model=model)) == ["switch 1, before it"]


def test_kernels_that_are_exchanged_are_found(contexts, monkeypatch):
    context = contexts["two_stage_rocket"]
    # Every kernel is right, but it is called in another phase.
    monkeypatch.setattr(context.module, "interval_gradient", context.module.phase_2_gradient)
    assert failing("derivatives", context) == []
    assert failing("assembly", context) == ["gradient of the Lagrangian"]


def test_bounds_of_another_phase_are_found(contexts, monkeypatch):
    context = contexts["two_stage_rocket"]
    right = context.module.variable_bounds

    def shifted(grid):
        lower, upper = right(grid)
        thrust = context.module.views(grid, upper)[1][0, :, -1]
        thrust[:] = np.roll(thrust, 1)
        return lower, upper

    monkeypatch.setattr(context.module, "variable_bounds", shifted)
    assert failing("given values", context) == ["bounds"]


def test_unknowns_that_another_phase_lacks_are_found(contexts, monkeypatch):
    context = contexts["two_stage_rocket"]
    monkeypatch.setattr(context.module, "PHASE_LACKS", np.roll(context.module.PHASE_LACKS, 1, axis=0))
    assert failing("layout", context) == ["sizes and patterns"]
