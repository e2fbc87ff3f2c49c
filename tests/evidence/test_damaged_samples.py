"""Kernels of samples, and measurements, that were damaged in an emitted text or in a module, are found."""

from __future__ import annotations

import re

import pytest
from evidence.conftest import PROBLEMS

from codegen.discretise import transcribe
from codegen.discretise.model.from_problem import load_problem
from codegen.emit.verify import verify
from codegen.errors import VerificationError
from codegen.evidence import checks
from codegen.runtime.search import grid
from codegen.solving.compiler import build

PROBLEM = PROBLEMS / "published" / "gas_oil.py"
DAMAGES = {
    "gradient": (r"def sample_gradient.*?gradient\[0\] \+= ", r"\g<0>1.001*"),
    "hessian": (r"def sample_hessian.*?hessian\[0\] \+= ", r"\g<0>1.001*"),
    "hessian-index": (r"(def sample_hessian.*?)hessian\[1\] \+= ", r"\1hessian[2] += "),
    "losses": (r"(def sample_gradient.*?)return x", r"\1return 2*x"),
    "fraction": (r"(def sample_hessian.*?)parameters\[sample \+ 1\]", r"\1parameters[sample + 2]"),
    "weight": (r"(def sample_gradient.*?)parameters\[sample \+ 5\]", r"\1parameters[sample + 4]"),
    "value": (r"(def sample_values.*?)values\[1\] = b_k", r"\1values[1] = 2*b_k"),
    "motion": (r"(def motion_hessian.*?)hessian\[3\] = ", r"\1hessian[3] = 1.001*"),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_sample_is_not_written(damage):
    program = transcribe.transcribe(load_problem(PROBLEM), None, None, "interval")
    text = build(PROBLEM).path.read_text()
    pattern, replacement = DAMAGES[damage]
    damaged = re.sub(pattern, replacement, text, count=1, flags=re.DOTALL)
    assert damaged != text
    with pytest.raises(VerificationError, match=r"sample|interval|measures"):
        verify(program, damaged)


def test_sound_measurements_pass_every_check(prepared):
    context = prepared(PROBLEM)
    for name in ("layout", "derivatives", "measurements", "assembly", "sparsity", "given values"):
        findings = checks.apply(name, context)
        assert all(finding.passed for finding in findings), [f for f in findings if not f.passed]
    assert len(checks.apply("measurements", context)) == 5


@pytest.mark.parametrize(
    ("old", "new", "check", "subject"),
    [
        ("0.025, 0.8105, 0.2", "0.025, 0.8106, 0.2", "measurements", "numbers"),
        ("gradient[1] += ", "gradient[1] += 1.001*", "measurements", "sample_gradient"),
        ("hessian[5] += ", "hessian[5] += 1.001*", "measurements", "sample_hessian"),
        ("parameters[sample] < t + h:\n        cost", "parameters[sample] < t:\n        cost", "assembly", "gradient"),
        ("        sample_hessian(unknowns", "        sample_gradient(unknowns", "assembly", "KKT matrix"),
    ],
)
def test_damaged_measurements_fail_a_check(prepared, damaged, old, new, check, subject):
    findings = checks.apply(check, damaged(prepared(PROBLEM), old, new))
    assert any(subject in finding.subject for finding in findings if not finding.passed), findings


@pytest.mark.parametrize(
    ("column", "check", "subject"),
    [(0, "measurements", "times of samples"), (1, "measurements", "times of samples"), (-1, "assembly", "gradient")],
    ids=["middle of the interval", "place in it", "weight"],
)
def test_samples_that_are_told_the_wrong_numbers_fail_a_check(prepared, monkeypatch, column, check, subject):
    """Where samples lie is found by code that is common to all modules."""
    context, own = prepared(PROBLEM), grid.samples_of

    def wrong(grid, rows):
        found = own(grid, rows)
        found[:, column] *= 2.0 if column else 0.5
        return found

    monkeypatch.setattr(grid, "samples_of", wrong)
    findings = checks.apply(check, context)
    assert any(subject in finding.subject for finding in findings if not finding.passed), findings
