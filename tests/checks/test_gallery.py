"""Every check passes on the gallery, and each applies to at least one of its problems."""

from __future__ import annotations

from pathlib import Path

import pytest
from checks.conftest import PROBLEMS

from codegen import checks

SILENT = {
    "pendulum": {"sparsity", "momentum matching", "discrete Noether", "boundary rank", "null controls", "optimum"},
    "linear_pendulum": {"discrete Noether"},
    "orbital_transfer": {"area preservation"},
}
"""Checks that do not apply: a simulation has no boundary value problem, and so on."""


@pytest.mark.parametrize("name", checks.CHECKS)
@pytest.mark.parametrize("problem", SILENT)
def test_passes(prepared, problem, name):
    findings = checks.apply(name, prepared(problem))
    assert bool(findings) == (name not in SILENT[problem])
    assert [finding for finding in findings if not finding.passed] == []


@pytest.mark.parametrize(
    ("problem", "arguments", "choices"),
    [
        ("pendulum", {"form": "lagrangian"}, {"scheme": "trapezoidal"}),
        ("pendulum", {}, {"scheme": "explicit-euler"}),
        ("pendulum", {}, {"scheme": "stormer-verlet"}),
        ("linear_pendulum", {}, {"method": "hamiltonian", "scheme": "stormer-verlet"}),
        ("linear_pendulum", {}, {"method": "hamiltonian", "scheme": "symplectic-euler"}),
        ("linear_pendulum", {}, {"scheme": "rectangle"}),
    ],
)
def test_passes_for_other_schemes(prepared, problem, arguments, choices):
    context = prepared(problem, arguments, **choices)
    findings = [finding for name in checks.CHECKS for finding in checks.apply(name, context)]
    assert {finding.check for finding in findings} >= {"derivatives", "consistency", "symplecticity"}
    assert [finding for finding in findings if not finding.passed] == []


def test_run_reports_provenance(prepared, tmp_path: Path):
    module = Path(prepared("pendulum").module.__file__)
    findings = checks.run(PROBLEMS / "pendulum.py", module=module)
    assert all(finding.passed for finding in findings)
    assert [f.subject for f in findings if f.check == "provenance"] == ["inputs", "text"]


def test_run_tells_an_altered_module_apart_and_still_checks_it(prepared, tmp_path: Path):
    text = Path(prepared("pendulum").module.__file__).read_text(encoding="utf-8")
    module = tmp_path / "pendulum.py"
    module.write_text(text.replace("# Left out", "# Omitted"), encoding="utf-8")
    inputs, wording, *others = checks.run(PROBLEMS / "pendulum.py", module=module)
    assert inputs.passed
    assert not wording.passed
    assert "line 5" in wording.detail
    assert "Omitted" in wording.detail
    assert all(finding.passed for finding in others)


def test_run_tells_other_inputs(prepared):
    module = Path(prepared("pendulum", {}, scheme="stormer-verlet").module.__file__)
    inputs, wording, layout, *others = checks.run(PROBLEMS / "pendulum.py", module=module)
    assert not layout.passed
    assert "stages is ('q_stage1', 'p_stage1'), expected ()" in layout.detail
    assert any(finding.passed for finding in others)
    assert not inputs.passed
    assert "other inputs" in inputs.detail
    assert not wording.passed
