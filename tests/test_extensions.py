"""What CONTRIBUTING.md promises: an extension is one file and one row, after which every part of the package knows it.

Each trial adds to a copy of the package what its recipe says, and nothing else; then commands run from the copy,
without compilation, in processes of their own.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

PACKAGE = Path(__file__).parents[1] / "codegen"

RADAU = '''"""Collocation at the points of Radau."""

from dataclasses import dataclass

from sympy import Rational, S

from codegen.schemes.base import FIRST_ORDER, Scheme
from codegen.schemes.step import FieldPoint, Step, Update


@dataclass(frozen=True)
class Radau(Scheme):
    """Stages at given abscissae, of which the last is the right node."""

    abscissae: tuple[Rational, ...]
    rows: tuple[tuple[Rational, ...], ...]

    def step(self) -> Step:
        numbers = range(1, len(self.rows) + 1)
        points = tuple(
            FieldPoint(c, weight, ((n, S.One),), ((n, S.One),))
            for n, c, weight in zip(numbers, self.abscissae, self.rows[-1], strict=True)
        )
        updates = tuple(Update(0, S.One, row) for row in self.rows)
        return Step(points, updates, updates, self.abscissae)


TWO_STAGES = Radau(
    "radau-3", order=3, symmetric=False, symplectic=False, source="Hairer and Wanner (1996), table IV.5.5",
    summary="Radau IIA with 2 stages", abscissae=(Rational(1, 3), S.One),
    rows=((Rational(5, 12), Rational(-1, 12)), (Rational(3, 4), Rational(1, 4))),
)
SCHEMES = {"hamiltonian": (TWO_STAGES,), FIRST_ORDER: (TWO_STAGES,)}
'''

MARQUARDT = '''"""The method of Levenberg and Marquardt on the KKT equations, which may claim what is not so."""

import numpy as np
from scipy.optimize import root

from codegen.drivers.scaled import ScaledProblem
from codegen.solutions.result import ControlAttempt


def control(module, run):
    problem = ScaledProblem.on_grid(module, run)
    count = problem.primal.size

    def equations(y):
        return np.concatenate([problem.stationarity(y[:count], y[count:]), problem.constraints(y[:count])])

    y = np.concatenate([problem.start, np.zeros(problem.dual.size)])
    if run.max_iterations != 1:
        y = root(equations, y, method="lm", options={"xtol": 1e-15, "ftol": 1e-15}).x
    return ControlAttempt("solved", "it says so", 1, problem.unknowns(y[:count], y[count:]), 1e-8)
'''

SUM_OF_SHARES = '''"""Evidence for the cost of a result: the midpoint rule on its states and controls gives it again."""

import numpy as np

from codegen.checks.base import Finding, does_not_apply


def check(context):
    if context.scheme.name != "midpoint":
        yield does_not_apply("cost of the motion", "other schemes have other rules")
        return
    result = context.solution
    x = result.q[:, 0]
    rate = ((x[:-1] + x[1:]) / 2) ** 2 / 2 + np.asarray(result.u)[:, 0] ** 2 / 2
    near = float((rate * np.diff(result.t)).sum())
    yield Finding("cost of the motion", "the whole problem", abs(near - result.cost) < 1e-9, f"{near:.12g}")
'''

STANDSTILL = '''"""What stands still at the end."""

from codegen.errors import ExpressionError
from codegen.model.conditions.base import Kind
from codegen.model.relations import MOVING, STATIC, Entry, checked_sequence


class Standstill(Kind):
    """Rates that are zero at the end; conditions there impose it."""

    argument, field, words = "standstill", "end_conditions", "conditions at its ends"
    scope = {"standstill": (*MOVING, *STATIC)}

    def written(self, control):
        for symbol in checked_sequence("standstill", control.standstill, "rate"):
            if symbol in control.end:
                raise ExpressionError(f"standstill lists {symbol}, which end gives", "leave it out of one of them")
            yield Entry("standstill", f"standstill of {symbol}", symbol, None, str(symbol), True)

    def values(self, model):
        return iter(())
'''

ORDERS = '''"""The command `codegen orders`: schemes by their orders."""

import typer


def orders() -> None:
    """List schemes with their orders."""
    from codegen import schemes

    for name, scheme in schemes.METHODS["hamiltonian"].items():
        typer.echo(f"{name} {scheme.order}")
'''

FILES = {
    "schemes/radau.py": RADAU,
    "drivers/marquardt.py": MARQUARDT,
    "checks/solution/cost_of_motion.py": SUM_OF_SHARES,
    "model/conditions/standstill.py": STANDSTILL,
    "cli/orders.py": ORDERS,
}
"""One file for each."""

HALTON = """
def _halton(number, dimensions, rng):
    from scipy.stats import qmc

    return qmc.Halton(dimensions, scramble=False).random(number)


METHODS"""
REGISTRIES = {
    "schemes/__init__.py": [
        ("from codegen.schemes import ", "from codegen.schemes import radau, "),
        ("_FAMILIES = (", "_FAMILIES = (radau, "),
    ],
    "drivers/__init__.py": [
        ("_ROWS = (", '_ROWS = (Driver("marquardt", "marquardt", "least squares", {"control": ("max_iterations",)}),')
    ],
    "checks/__init__.py": [
        ("from codegen.checks.solution import ", "from codegen.checks.solution import cost_of_motion, "),
        ("_ROWS = (", '_ROWS = (Check("cost of the motion", cost_of_motion.check, without=NO_REGULATORS),'),
        ("_ROWS", 'NO_REGULATORS = {"simulate": "it minimises nothing", "lagrangian": "it is no regulator"}\n\n_ROWS'),
    ],
    "model/conditions/table.py": [
        ("from codegen", "from codegen.model.conditions.standstill import Standstill\nfrom codegen"),
        ("CONDITIONS: tuple[Kind, ...] = (", "CONDITIONS: tuple[Kind, ...] = (Standstill(),"),
    ],
    "cli/__init__.py": [("COMMANDS = (", 'COMMANDS = ("orders", ')],
    "author/problem.py": [("    periodic: ", "    standstill: Sequence[Any] = ()\n    periodic: ")],
    "sweeping/samples.py": [("METHODS", HALTON), ('    "random": ', '    "halton": _halton,\n    "random": ')],
}
"""A row and its import for each; of a condition the argument, of a sampling method the function beside the row."""


class Extended:
    """A copy of the package with all trials in it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        shutil.copytree(PACKAGE, folder / "codegen", ignore=shutil.ignore_patterns("__pycache__"))
        for name, text in FILES.items():
            (folder / "codegen" / name).write_text(text, encoding="utf-8")
        for name, rows in REGISTRIES.items():
            path = folder / "codegen" / name
            text = path.read_text(encoding="utf-8")
            for old, new in rows:
                assert f"\n{old}" in text, (name, old)
                text = text.replace(f"\n{old}", f"\n{new}", 1)
            path.write_text(text, encoding="utf-8")
        self.problems = folder / "codegen" / "stress" / "problems"

    def python(self, *words: str | Path) -> subprocess.CompletedProcess[str]:
        paths = {"PYTHONPATH": str(self.folder), "CODEGEN_CACHE_DIR": str(self.folder / "cache")}
        environment = {**os.environ, **paths, "NUMBA_DISABLE_JIT": "1", "COLUMNS": "200"}
        return subprocess.run(
            [sys.executable, *map(str, words)],
            capture_output=True, text=True, cwd=self.folder, env=environment, check=False,
        )  # fmt: skip

    def command(self, *words: str | Path, status: int = 0) -> str:
        done = self.python("-m", "codegen", *words)
        assert done.returncode == status, done.stderr
        return done.stdout

    def refused(self, *words: str | Path) -> str:
        done = self.python("-m", "codegen", *words)
        assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
        return done.stderr

    def solved(self, problem: Path, *words: str, status: int = 0) -> Mapping[str, object]:
        return json.loads(self.command("solve", problem, "--json", *words, status=status))


@pytest.fixture(scope="module")
def extended(tmp_path_factory: pytest.TempPathFactory) -> Extended:
    return Extended(tmp_path_factory.mktemp("extended"))


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
        assert re.search(r"consistency +order of radau-3 +passed", printed)

    def test_it_has_a_limit_and_a_colour_and_cases_of_stress(self, extended):
        code = """
from codegen import schemes
from codegen.report.figures.problems import colour_of
from codegen.stress import families, linear
names = [name for names in schemes.METHODS.values() for name in names]
assert len({colour_of(name) for name in names}) == len(set(names))
assert linear.limit(schemes.METHODS["hamiltonian"]["radau-3"]) == float("inf")
cases = [case for case in families.all_cases() if case.setup.scheme == "radau-3"]
print(sorted({case.setup.file.stem for case in cases}), len(cases))
"""
        done = extended.python("-c", code)
        assert done.returncode == 0, done.stderr
        assert done.stdout == "['oscillator'] 7\n"

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
        done = extended.python(
            "-m", "codegen", "solve", extended.problems / "linear_regulator.py", "--driver", "marquard"
        )
        assert (done.returncode, done.stdout) == (2, "")
        assert "did you mean marquardt?" in done.stderr
        done = extended.python("-m", "codegen", "solve", extended.problems / "oscillator.py", "--driver", "marquardt")
        assert done.returncode == 2
        assert "driver marquardt does not apply to a simulate problem" in done.stderr


def test_check(extended):
    printed = extended.command("check", extended.problems / "linear_regulator.py")
    assert re.search(r"cost of the motion.*1\.6", printed, re.DOTALL)
    assert "it minimises nothing" in extended.command("check", extended.problems / "oscillator.py")


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

    def test_its_refusals_are_one_line(self, extended, stop):
        found = extended.refused("build", stop("refused", "end={x: 1, dx: 0}, standstill=[dx]"))
        assert "standstill lists dx, which end gives; leave it out of one of them" in found
        found = extended.refused("build", stop("scope", "end={x: 1}, standstill=[u]"))
        assert "standstill of u depends on u; use coordinates" in found


def test_sampling_method(extended):
    done = extended.python(
        "-c", "from codegen.sweeping.samples import samples\nprint(samples({'a': 'uniform(0, 8)'}, 3, 'halton', 0))"
    )
    assert done.returncode == 0, done.stderr
    assert all(value in done.stdout for value in ("4.0", "2.0"))


def test_command(extended):
    assert "radau-3 3\n" in extended.command("orders")
    assert "List schemes with their orders." in extended.command("--help")
