"""`codegen analyse`: what is refused, the text, the command."""

from __future__ import annotations

import pytest
from conftest import PROBLEMS
from typer.testing import CliRunner

from codegen.cli import main
from codegen.errors import ArgumentError, SchemeError
from codegen.evidence.analysis.modified_equations import analysis


@pytest.mark.parametrize("order", [0, -1, 9])
def test_order_out_of_range_is_refused(order):
    with pytest.raises(ArgumentError, match=f"--order {order}"):
        analysis(PROBLEMS / "pendulum.py", order=order)


@pytest.mark.parametrize(
    ("problem", "reason"),
    [
        ("bouncing_ball", "several phases"),
        ("spherical_pendulum", "holonomic"),
        ("outer_solar_system", "particles"),
    ],
)
def test_problem_without_modified_equations_is_refused(problem, reason):
    with pytest.raises(ArgumentError, match=reason):
        analysis(PROBLEMS / f"{problem}.py")


def test_family_is_for_hamiltonian_problems():
    with pytest.raises(SchemeError, match="alpha"):
        analysis(PROBLEMS / "van_der_pol.py", scheme="alpha")


def test_text_begins_with_the_conclusion():
    text = analysis(PROBLEMS / "pendulum.py", scheme="symplectic-euler", order=2)
    assert text.startswith("symplectic-euler on pendulum: modified equations up to h² are Hamiltonian\n")
    text = analysis(PROBLEMS / "pendulum.py", scheme="explicit-euler", order=2)
    assert text.startswith("explicit-euler on pendulum: modified equations up to h² are not Hamiltonian, because")
    text = analysis(PROBLEMS / "pendulum.py", {"form": "lagrangian"}, order=1)
    assert "Coefficient of h\n----------------\n  it vanishes" in text
    assert analysis(PROBLEMS / "pendulum.py", scheme="alpha", order=1).startswith("alpha family on pendulum")


def test_command():
    shown = CliRunner().invoke(main, ["analyse", str(PROBLEMS / "orbital_transfer.py"), "--order", "1", "--latex"])
    assert shown.exit_code == 0
    assert shown.stdout.isascii()
    assert shown.stdout.count(r"\begin{align*}") == shown.stdout.count(r"\end{align*}") == 2
    refused = CliRunner().invoke(main, ["analyse", str(PROBLEMS / "pendulum.py"), "--order", "0"])
    assert refused.exit_code == 2
    assert refused.stderr == "codegen: error: --order 0; give a power of h from 1 to 8\n"
