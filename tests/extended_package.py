"""A copy of the package with another family of schemes, driver, check, kinds of condition, sampling and command."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "codegen"

RADAU = '''"""Collocation at the points of Radau."""

from dataclasses import dataclass

from sympy import Rational, S

from codegen.discretise.schemes.base import FIRST_ORDER, Scheme
from codegen.discretise.schemes.base import FieldPoint, Step, Update


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

from codegen.solving.drivers.shared import ScaledProblem
from codegen.solving.results.result import ControlAttempt


def control(module, run):
    problem = ScaledProblem.on_grid(module, run)
    program = problem.program
    count = program.primal.size

    def equations(y):
        return np.concatenate([problem.stationarity(y[:count], y[count:]), problem.constraints(y[:count])])

    y = np.concatenate([program.x0, np.zeros(program.dual.size)])
    if run.max_iterations != 1:
        y = root(equations, y, method="lm", options={"xtol": 1e-15, "ftol": 1e-15}).x
    return ControlAttempt("solved", "it says so", 1, problem.unknowns(y[:count], y[count:]), 1e-8)
'''

SUM_OF_SHARES = '''"""Evidence for the cost of a result: the midpoint rule on its states and controls gives it again."""

import numpy as np

from codegen.evidence.checks.base import Finding, does_not_apply


def check(context):
    if context.scheme.name != "midpoint" or len(context.model.controls) != 1:
        yield does_not_apply("cost of the motion", "others have other rules")
        return
    result = context.solution
    x = result.q[:, 0]
    rate = ((x[:-1] + x[1:]) / 2) ** 2 / 2 + np.asarray(result.u)[:, 0] ** 2 / 2
    near = float((rate * np.diff(result.t)).sum())
    yield Finding("cost of the motion", "the whole problem", abs(near - result.cost) < 1e-9, f"{near:.12g}")
'''

STANDSTILL = '''"""What stands still at the end."""

from codegen.errors import ExpressionError
from codegen.discretise.conditions.base import ConditionKind
from codegen.discretise.model.relations import MOVING, STATIC, Entry, checked_sequence


class Standstill(ConditionKind):
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

BALANCE = '''"""Equations that hold at every node."""

from codegen.problem.symbols import Coordinate, State
from codegen.discretise.conditions.base import ConditionKind
from codegen.discretise.conditions.path import nodal_equalities
from codegen.discretise.model.relations import STATIC


class Balance(ConditionKind):
    """Equations between coordinates or states."""

    argument = field = "balance"
    words, check = "balances", "balance of nodes"
    scope = {"balance": (Coordinate, State, *STATIC)}

    def sentences(self, model):
        return [f"{c.name} at every node" for c in model.balance]


def balances(model, names):
    """Balances have a multiplier on each node."""
    return nodal_equalities(model, model.balance, "lambda_balance", names)
'''

BALANCE_OF_NODES = '''"""Evidence that balances hold at the nodes of a result."""

import numpy as np
import sympy

from codegen.evidence.checks.base import Finding


def check(context):
    model = context.model
    for condition in model.balance:
        function = sympy.lambdify([model.coordinates, model.parameters], condition.expression)
        largest = max(abs(function(q, model.defaults)) for q in context.solution.q)
        yield Finding("balance of nodes", condition.name, bool(largest < 1e-9), f"{largest:.1e}")
'''

ORDERS = '''"""The command `codegen orders`: schemes by their orders."""

import typer


def orders() -> None:
    """List schemes with their orders."""
    from codegen.discretise import schemes

    for name, scheme in schemes.METHODS["hamiltonian"].items():
        typer.echo(f"{name} {scheme.order}")
'''

FILES = {
    "discretise/schemes/radau.py": RADAU,
    "solving/drivers/marquardt.py": MARQUARDT,
    "evidence/checks/cost_of_motion.py": SUM_OF_SHARES,
    "discretise/conditions/standstill.py": STANDSTILL,
    "cli/orders.py": ORDERS,
    "discretise/conditions/balance.py": BALANCE,
    "evidence/checks/balance_of_nodes.py": BALANCE_OF_NODES,
}
"""One file for each."""

HALTON = """
def _halton(number, dimensions, rng):
    from scipy.stats import qmc

    return qmc.Halton(dimensions, scramble=False).random(number)


SAMPLINGS"""
REGISTRIES = {
    "discretise/schemes/__init__.py": [
        ("from codegen.discretise.schemes import ", "from codegen.discretise.schemes import radau, "),
        ("_FAMILIES = (", "_FAMILIES = (radau, "),
    ],
    "solving/drivers/__init__.py": [
        ("_ROWS = (", '_ROWS = (Driver("marquardt", "marquardt", "least squares", {"control": ("max_iterations",)}),')
    ],
    "evidence/checks/__init__.py": [
        ("from codegen", "from codegen.evidence.checks import balance_of_nodes, cost_of_motion\nfrom codegen"),
        ("_ROWS = (", '_ROWS = (Check("balance of nodes", balance_of_nodes.check),'),
        ("_ROWS = (", '_ROWS = (Check("cost of the motion", cost_of_motion.check, without=NO_REGULATORS),'),
        ("_ROWS", 'NO_REGULATORS = {"simulate": "it minimises nothing", "lagrangian": "it is no regulator"}\n\n_ROWS'),
    ],
    "discretise/conditions/__init__.py": [
        ("from codegen", "from codegen.discretise.conditions.balance import Balance\nfrom codegen"),
        ("from codegen", "from codegen.discretise.conditions.standstill import Standstill\nfrom codegen"),
        (
            "CONDITIONS: tuple[ConditionKind, ...] = (",
            "CONDITIONS: tuple[ConditionKind, ...] = (Standstill(), Balance(),",
        ),
    ],
    "cli/__init__.py": [("COMMANDS = {", 'COMMANDS = {"orders": "orders", ')],
    "problem/problem.py": [
        ("    periodic: ", "    standstill: Sequence[Any] = ()\n    periodic: "),
        ("    periodic: ", "    balance: Sequence[Any] = ()\n    periodic: "),
    ],
    "discretise/model/definitions.py": [
        ("    holonomic: ", "    balance: tuple[Condition, ...] = ()\n    holonomic: ")
    ],
    "discretise/assembly.py": [
        ("from codegen", "from codegen.discretise.conditions.balance import balances\nfrom codegen"),
        ("    at_inner_times, ", "    nodal += balances(model, names)\n    at_inner_times, "),
    ],
    "batch/cases.py": [("SAMPLINGS", HALTON), ('    "random": ', '    "halton": _halton,\n    "random": ')],
}
"""A row and its import for each; of a condition the argument, of a sampling method the function beside the row.

A field of the model is named there, and its share is added up with the others.
"""


PROBLEM = '''"""A problem of the stress cases."""
from codegen.evidence.stress.problems import {name}


def problem():
    return {name}()
'''
COMMANDS = """
import json, os, sys
import codegen.cli.solve, codegen.emit.verify, codegen.evidence.checks, codegen.solving.api
from codegen.__main__ import run
for line in sys.stdin:
    words, *files = json.loads(line)
    if not (child := os.fork()):
        for number, file in enumerate(files, 1):
            os.dup2(os.open(file, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
        sys.argv = ["codegen", *words]
        sys.exit(run())
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""
"""The process of which commands are forks: it reads words and two files, and prints exit statuses."""


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
        self.problems = folder / "problems"
        self.problems.mkdir()
        for name in ("oscillator", "linear_regulator"):
            (self.problems / f"{name}.py").write_text(PROBLEM.format(name=name), encoding="utf-8")

        paths = {"PYTHONPATH": str(self.folder), "CODEGEN_CACHE_DIR": str(self.folder / "cache")}
        self.environment = {**os.environ, **paths, "NUMBA_DISABLE_JIT": "1", "COLUMNS": "200"}
        self.commands = subprocess.Popen(
            [sys.executable, "-c", COMMANDS],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=folder, env=self.environment,
        )  # fmt: skip

    def python(self, *words: str | Path) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, *map(str, words)],
            capture_output=True, text=True, cwd=self.folder, env=self.environment, check=False,
        )  # fmt: skip

    def codegen(self, *words: str | Path) -> subprocess.CompletedProcess[str]:
        """What a command does, in a fork."""
        files = [self.folder / "stdout", self.folder / "stderr"]
        self.commands.stdin.write(json.dumps([[*map(str, words)], *map(str, files)]) + "\n")
        self.commands.stdin.flush()
        status = int(self.commands.stdout.readline())
        return subprocess.CompletedProcess(words, status, *(file.read_text(encoding="utf-8") for file in files))

    def command(self, *words: str | Path, status: int = 0) -> str:
        done = self.codegen(*words)
        assert done.returncode == status, done.stderr
        return done.stdout

    def refused(self, *words: str | Path) -> str:
        done = self.codegen(*words)
        assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
        return done.stderr

    def solved(self, problem: Path, *words: str, status: int = 0) -> Mapping[str, object]:
        return json.loads(self.command("solve", problem, "--json", *words, status=status))
