"""What CONTRIBUTING.md promises: an extension is one file and one row, after which every part of the package knows it.

Each trial adds to a copy of the package what its recipe says, and nothing else; then commands run from the copy,
without compilation, in processes of their own, which are forks of one that has imported what commands import.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from extended_package import Extended


@pytest.fixture(scope="module")
def extended(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Extended]:
    made = Extended(tmp_path_factory.mktemp("extended"))
    yield made
    made.commands.communicate()


class TestSchemeFamily:
    @pytest.mark.parametrize("steps", [10, 20])
    def test_it_simulates_by_its_stability_function(self, extended, steps):
        """From rest at 1, q + i p is multiplied by R(-i h) in each step (Hairer and Wanner 1996, IV.3)."""
        extended.solved(
            extended.problems / "oscillator.py", "--scheme", "radau-3", "--steps", str(steps), "--save", "motion.npz"
        )
        z = -1j * 10.0 / steps
        factor = (1 + z / 3) / (1 - 2 * z / 3 + z**2 / 6)
        with np.load(extended.folder / "motion.npz") as archive:
            motion = archive["q"][:, 0] + 1j * archive["p"][:, 0]
        np.testing.assert_allclose(motion, factor ** np.arange(steps + 1), atol=1e-12)

    def test_it_solves_control_problems(self, extended):
        """The regulator's optimal cost in closed form, from the Hamiltonian system x' = -x - y, y' = y - x."""
        rate = np.sqrt(2.0)
        found = extended.solved(extended.problems / "linear_regulator.py", "--scheme", "radau-3", "--steps", "400")
        grow, decay = np.exp(10.0 * rate), np.exp(-10.0 * rate)
        a, b = np.linalg.solve([[1.0, 1.0], [grow, decay]], [1.5, 1.0])
        adjoint = [-(1 + rate) * a - (1 - rate) * b, -(1 + rate) * a * grow - (1 - rate) * b * decay]
        assert found["cost"] == pytest.approx((1.5 * adjoint[0] - adjoint[1]) / 2.0, rel=1e-3)

    def test_checks_know_it(self, extended):
        printed = extended.command("check", extended.problems / "oscillator.py", "--scheme", "radau-3")
        assert re.search(r"passed +consistency: order of radau-3", printed)

    def test_it_has_a_limit_and_a_colour_and_cases_of_stress(self, extended):
        code = """
from codegen.discretise import schemes
from codegen.evidence.report.page import colour_of
from codegen.evidence.stress import families, systems
names = [name for names in schemes.METHODS.values() for name in names]
assert len({colour_of(name) for name in names}) == len(set(names))
assert systems.limit(schemes.METHODS["hamiltonian"]["radau-3"]) == float("inf")
cases = [case for case in families.all_cases() if case.setup.scheme == "radau-3"]
print(sorted({case.setup.problem for case in cases}), len(cases))
"""
        done = extended.python("-c", code)
        assert done.returncode == 0, done.stderr
        assert done.stdout == "['oscillator', 'prothero_robinson'] 11\n"

    def test_its_modified_equation_is_shown(self, extended):
        assert "radau-3" in extended.command("show", extended.problems / "oscillator.py", "--scheme", "radau-3")


class TestDriver:
    def test_it_solves_and_its_residuals_are_evaluated_anew(self, extended):
        found, known = (
            extended.solved(extended.problems / "linear_regulator.py", "--steps", "20", "--driver", driver)
            for driver in ("marquardt", "newton")
        )
        assert (found["status"], found["driver"]) == ("solved", "marquardt")
        assert found["cost"] == pytest.approx(known["cost"], rel=1e-9)

    def test_it_is_not_believed(self, extended):
        words = "--steps", "20", "--driver", "marquardt", "--max-iterations", "1"
        found = extended.solved(extended.problems / "linear_regulator.py", *words, status=1)
        assert found["status"] != "solved"
        assert found["residual"] > 1e-3

    def test_refusals_name_it(self, extended):
        done = extended.codegen("solve", extended.problems / "linear_regulator.py", "--driver", "marquard")
        assert (done.returncode, done.stdout) == (2, "")
        assert "did you mean marquardt?" in done.stderr
        done = extended.codegen("solve", extended.problems / "oscillator.py", "--driver", "marquardt")
        assert done.returncode == 2
        assert "driver marquardt does not apply to a simulate problem" in done.stderr


def test_check(extended):
    printed = extended.command("check", extended.problems / "linear_regulator.py")
    assert re.search(r"cost of the motion.*1\.6", printed, re.DOTALL)
    printed = " ".join(extended.command("check", extended.problems / "oscillator.py").split())
    assert "cost of the motion" in printed.partition("not applicable: ")[2]


STOP = """'''Move a mass by one. Source: any textbook.'''
from codegen import Control, control, coordinates


def problem():
    (x,), (dx,) = coordinates("x")
    u = control("u")
    return Control(
        lagrangian=dx**2 / 2, force={x: u}, cost=u**2 / 2, duration=1, start={x: 0, dx: 0}, CONDITION, steps=50
    )
"""


class TestCondition:
    @pytest.fixture
    def stop(self, extended):
        def write(name: str, condition: str) -> Path:
            path = extended.folder / f"{name}.py"
            path.write_text(STOP.replace("CONDITION", condition), encoding="utf-8")
            return path

        return write

    def test_it_holds(self, extended, stop):
        """Moving by 1 from rest to rest costs 6, the integral of (6 - 12 t)^2/2, up to a part of h^2."""
        condition = extended.solved(stop("standing", "end={x: 1}, standstill=[dx]"))
        value = extended.solved(stop("given", "end={x: 1, dx: 0}"))
        assert condition["cost"] == pytest.approx(value["cost"], rel=1e-9)
        assert condition["cost"] == pytest.approx(6.0, rel=1e-2)

    def test_it_is_checked_and_shown(self, extended, stop):
        path = stop("checked", "end={x: 1}, standstill=[dx]")
        assert " 0 failed" in extended.command("check", path)
        assert "\n  (dx)(T) = " in extended.command("show", path)

    def test_notebooks_display_it(self, extended, stop):
        path = stop("displayed", "end={x: 1}, standstill=[dx]")
        done = extended.python("-c", f"import runpy; print(runpy.run_path({str(path)!r})['problem']()._repr_latex_())")
        assert done.returncode == 0, done.stderr
        assert r"&\dot{x} = 0\quad\text{(standstill)}" in done.stdout

    def test_its_refusals_are_one_line(self, extended, stop):
        found = extended.refused("build", stop("refused", "end={x: 1, dx: 0}, standstill=[dx]"))
        assert "standstill lists dx, which end gives; leave it out of one of them" in found
        found = extended.refused("build", stop("scope", "end={x: 1}, standstill=[u]"))
        assert "standstill of u depends on u; use coordinates" in found


PAIR = '''"""Move two carts by one, together. Source: any textbook."""
from sympy import Eq

from codegen import Control, controls, states


def problem():
    x, y = states("x y")
    u, w = controls("u w")
    return Control(
        dynamics={x: u, y: w}, cost=(u**2 + 3 * w**2) / 2, duration=1, start={x: 0, y: 0}, end={x: 1},
        balance=[Eq(2 * x, y)], steps=20,
    )
'''


class TestFieldOfTheModel:
    @pytest.fixture
    def pair(self, extended):
        path = extended.folder / "pair.py"
        path.write_text(PAIR, encoding="utf-8")
        return path

    def test_it_holds(self, extended, pair):
        """With w = 2 u, and u = 1 all along, the cost is (1 + 12)/2."""
        assert extended.solved(pair)["cost"] == pytest.approx(6.5, rel=1e-9)

    def test_it_is_told_and_checked(self, extended, pair):
        printed = extended.command("check", pair)
        assert " 0 failed" in printed
        assert re.search(r"passed +balance of nodes: 2\*x = y", printed)
        problem = extended.problems / "linear_regulator.py"
        printed = " ".join(extended.command("check", problem).split())
        assert "balance of nodes" in printed.partition("not applicable: ")[2]

    def test_values_of_the_past_do_not_go_with_it(self, extended, pair):
        text = pair.read_text(encoding="utf-8").replace("x: u,", "x: u - x.delayed(0.5), ")
        delayed = extended.folder / "delayed.py"
        delayed.write_text(text.replace("duration", "history={x: 0}, duration"), encoding="utf-8")
        assert "balance beside the delay 1/2 of x" in extended.refused("build", delayed)


def test_sampling_method(extended):
    done = extended.python(
        "-c", "from codegen.batch.cases import samples\nprint(samples({'a': 'uniform(0, 8)'}, 3, 'halton', 0))"
    )
    assert done.returncode == 0, done.stderr
    assert all(value in done.stdout for value in ("4.0", "2.0"))


def test_command(extended):
    assert "radau-3 3\n" in extended.python("-m", "codegen", "orders").stdout  # a whole process
    assert "List schemes with their orders." in extended.command("--help")
