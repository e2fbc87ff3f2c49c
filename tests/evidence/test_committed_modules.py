"""Every check passes on the gallery, and each applies to at least one of its problems."""

from __future__ import annotations

from pathlib import Path

import pytest
from control_variants import ANTIPHASE
from evidence.conftest import PROBLEMS

from codegen.evidence import checks

ABOUT_CONTROL = {
    "sparsity",
    "given values",
    "assembly",
    "momentum matching",
    "boundary rank",
    "null controls",
    "inner times",
    "path between nodes",
    "holonomic drift",
    "switches",
    "second-order condition",
    "optimum",
}
ABOUT_MECHANICS = {
    "momentum matching",
    "discrete Noether",
    "symplecticity",
    "area preservation",
    "midpoint equivalence",
}
SILENT = {
    "pendulum": {*ABOUT_CONTROL, "discrete Noether"},
    "linear_pendulum": {"inner times", "path between nodes", "discrete Noether", "holonomic drift", "switches"},
    "orbital_transfer": {"inner times", "path between nodes", "area preservation", "holonomic drift", "switches"},
    "hovercraft": {
        "inner times",
        "path between nodes",
        "area preservation",
        "holonomic drift",
        "switches",
        "optimum",
    },  # several bodies, coupled at the end
    "double_integrator": {
        "inner times",
        "path between nodes",
        "holonomic drift",
        "switches",
        "optimum",
    },  # free duration, bounded control
    "low_thrust": {
        "area preservation",
        "inner times",
        "path between nodes",
        "holonomic drift",
        "switches",
        "optimum",
    },  # path inequality, end condition, end cost
    "spherical_pendulum": {
        "inner times",
        "area preservation",
        "switches",
        "optimum",
    },  # holonomic constraint
    "van_der_pol": {
        *ABOUT_MECHANICS,
        "inner times",
        "path between nodes",
        "holonomic drift",
        "switches",
        "optimum",
    },  # first-order system
}
SILENT = {
    problem: {
        *names,
        "rolling constraints",
        "contact",
        "integrals",
        "tables",
        "measurements",
        "delays",
        "sensitivities",
    }
    for problem, names in SILENT.items()
}
"""Checks that do not apply: a simulation has no boundary value problem, and so on; see test_phase_checks for phases."""


@pytest.mark.parametrize("name", checks.CHECKS)
@pytest.mark.parametrize("problem", SILENT)
def test_passes(prepared, problem, name):
    findings = checks.apply(name, prepared(problem))
    assert [finding for finding in findings if not finding.passed] == []
    assert [finding.applies for finding in findings] == [name not in SILENT[problem]] * len(findings)
    assert findings
    if name in SILENT[problem]:
        assert "does not apply: " in findings[0].detail


@pytest.mark.parametrize(
    ("problem", "arguments", "choices"),
    [
        ("pendulum", {"form": "lagrangian"}, {"scheme": "trapezoidal"}),
        ("pendulum", {}, {"scheme": "explicit-euler"}),
        ("pendulum", {}, {"scheme": "stormer-verlet"}),
        ("pendulum", {}, {"scheme": "blanes-moan-4"}),
        ("linear_pendulum", {}, {"scheme": "lobatto-4"}),
        ("linear_pendulum", {}, {"method": "hamiltonian", "scheme": "stormer-verlet"}),
        ("linear_pendulum", {}, {"method": "hamiltonian", "scheme": "symplectic-euler"}),
        ("linear_pendulum", {}, {"scheme": "rectangle"}),
        ("double_integrator", {}, {"method": "hamiltonian"}),
        ("van_der_pol", {}, {"scheme": "trapezoidal"}),
    ],
)
def test_passes_for_other_schemes(prepared, problem, arguments, choices):
    context = prepared(problem, arguments, **choices)
    findings = [finding for name in checks.CHECKS for finding in checks.apply(name, context)]
    assert {finding.check for finding in findings} == set(checks.CHECKS)
    assert [finding for finding in findings if not finding.passed] == []


@pytest.mark.parametrize("method", ["variational", "hamiltonian"])
def test_passes_for_periodic_coupled_bodies_with_a_free_period(prepared, tmp_path: Path, method):
    path = tmp_path / "antiphase.py"
    path.write_text(ANTIPHASE)
    context = prepared(path, {}, method=method)
    findings = [finding for name in checks.CHECKS for finding in checks.apply(name, context)]
    assert [finding for finding in findings if not finding.passed] == []
    (rank,) = [f for f in findings if f.subject == "conditions between bodies"]
    assert rank.detail == "1 of 1 are independent, none is redundant"


def test_run_reports_provenance(prepared, interpreting):
    module = Path(prepared("pendulum").module.__file__)
    findings = checks.run(PROBLEMS / "pendulum.py", module=module)
    assert all(finding.passed for finding in findings)
    assert [f.subject for f in findings if f.check == "provenance"] == ["inputs", "text"]


def test_run_tells_an_altered_module_apart_and_still_checks_it(prepared, interpreting, tmp_path: Path):
    text = Path(prepared("pendulum").module.__file__).read_text(encoding="utf-8")
    module = tmp_path / "pendulum.py"
    module.write_text(text.replace("# Left out", "# Omitted"), encoding="utf-8")
    inputs, wording, *others = checks.run(PROBLEMS / "pendulum.py", module=module)
    assert inputs.passed
    assert not wording.passed
    assert "line 6" in wording.detail
    assert "Omitted" in wording.detail
    assert all(finding.passed for finding in others)


def test_run_tells_other_inputs(prepared, interpreting):
    module = Path(prepared("pendulum", {}, scheme="stormer-verlet").module.__file__)
    inputs, wording, layout, *others = checks.run(PROBLEMS / "pendulum.py", module=module)
    assert not layout.passed
    assert "stages is ('q_stage1', 'p_stage1'), expected ()" in layout.detail
    assert any(finding.passed for finding in others)
    assert not inputs.passed
    assert "other inputs" in inputs.detail
    assert not wording.passed
