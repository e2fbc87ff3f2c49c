"""Sensitivities pass where they are right, and say nothing where a solution has none."""

import pytest

from codegen.evidence import checks


@pytest.mark.parametrize(
    ("problem", "choices"),
    [
        ("linear_pendulum", {}),
        ("linear_pendulum", {"method": "hamiltonian", "scheme": "stormer-verlet"}),
        ("hovercraft", {}),
        ("brachistochrone", {}),
        ("bouncing_ball", {}),
        ("spherical_pendulum", {}),
        ("van_der_pol", {"scheme": "trapezoidal"}),
    ],
)
def test_passes(prepared, problem, choices):
    findings = checks.apply("sensitivities", prepared(problem, sensitivities=True, **choices))
    assert findings
    for finding in findings:
        assert finding.passed, finding.detail
        assert finding.applies, finding.detail
        assert "differ by at most" in finding.detail


def test_vertex_is_not_measured(prepared):
    findings = checks.apply("sensitivities", prepared("double_integrator", sensitivities=True))
    assert all(finding.passed and not finding.applies for finding in findings)
    assert {finding.detail for finding in findings} == {
        "not measured: equations, or active bounds, depend on each other at the solution"
    }


LIFT = '''"""Lift a mass to the ceiling, which it cannot pass."""

from codegen import Control, control, coordinate, parameters


def problem():
    (y, dy), u = coordinate("y"), control("u")
    m, top = parameters(m=2, top=1)
    return Control(
        lagrangian=m * dy**2 / 2,
        force={y: u},
        cost=u**2,
        duration=3,
        start={y: 0, dy: 0},
        end={y: top, dy: 0},
        bounds={y: (None, 1)},
        steps=12,
    )
'''


def test_quantities_that_cannot_change_are_named(prepared, tmp_path):
    (tmp_path / "lift.py").write_text(LIFT)
    findings = list(checks.apply("sensitivities", prepared(tmp_path / "lift.py", sensitivities=True)))
    assert [finding.subject for finding in findings] == [
        "all quantities by themselves, 12 intervals, without end.y",
        "parameters, which others follow, 12 intervals, without top",
    ]
    for finding in findings:
        assert finding.passed, finding.detail
        assert finding.applies, finding.detail


def test_modules_without_sensitivities_are_not_asked(prepared):
    (finding,) = checks.apply("sensitivities", prepared("linear_pendulum"))
    assert finding.detail == "does not apply: the module has none, unless it is built with --sensitivities"
