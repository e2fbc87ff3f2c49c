"""How processes that compile modules make numba quicker, and that what they compile is the same."""

import os
import subprocess
import sys

import numpy as np
import pytest
from numba import njit
from numba.core import types
from numba.core.errors import TypingError

from codegen.machine_code.operators import remembered_operators

MODULE = """
import numpy as np
from numba import njit

COUNT = 3

@njit(error_model="numpy")
def power_sum(values, count, exponent):
    total = 0.0
    for i in range(count):
        total += values[i] ** exponent
    return total

@njit(error_model="numpy")
def ratio(values, count):
    return power_sum(values, count, 2) / power_sum(values, COUNT, 3)

@njit(cache=True, error_model="numpy")
def outer(values):
    return ratio(values, values.size) + power_sum(values, COUNT, 1)
"""

COMPILE = """
import sys
from pathlib import Path
from numba import njit
from codegen.machine_code import compilation
from codegen.loading import GeneratedModule
sys.path.insert(0, sys.argv[1])
njit(lambda x: x)(0.0)
import linked
compilation.LONG = int(sys.argv[2])
compilation.compile_for_callers(linked)
import numpy as np
print(linked.outer(np.array([1.0, 2.0, 3.0, 4.0])))
print(*[len(f.signatures) for f in (linked.power_sum, linked.ratio, linked.outer)])
print(*[f.overloads[f.signatures[0]].library.is_inner for f in (linked.power_sum, linked.ratio, linked.outer)])
"""

AGAIN = """
import sys
from numba import njit
from codegen.machine_code import compilation
sys.path.insert(0, sys.argv[1])
njit(lambda x: x)(0.0)
import linked
compilation.compile_for_callers(linked)
import numpy as np
print(linked.outer(np.array([1.0, 2.0, 3.0, 4.0])), sum(linked.outer.stats.cache_hits.values()))
"""

USE = """
import sys
sys.path.insert(0, sys.argv[1])
import linked, numpy as np
print(linked.outer(np.array([1.0, 2.0, 3.0, 4.0])), sum(linked.outer.stats.cache_misses.values()))
print(linked.power_sum(np.array([1.0, 2.0, 3.0, 4.0]), 4, 2))
"""


def output(program: str, *arguments: object) -> list[str]:
    """What a new process prints."""
    command = [sys.executable, "-c", program, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=True, env=os.environ).stdout.split()


@pytest.mark.parametrize("long", [10, 100_000])
def test_functions_that_only_compiled_ones_call_have_code_in_their_callers_alone(tmp_path, long):
    """Whether they are kept on the disk themselves (`long` is few bytes) or not."""
    (tmp_path / "linked.py").write_text(MODULE)
    expected = (1 + 4 + 9 + 16) / (1 + 8 + 27) + (1 + 2 + 3)
    value, *rest = output(COMPILE, tmp_path, long)
    assert float(value) == pytest.approx(expected, rel=1e-15)
    assert rest == ["1", "1", "1", "True", "True", "False"]  # one signature each; the last is machine code
    value, hits = output(AGAIN, tmp_path)  # one process that compiles may need what another one has compiled
    assert float(value) == pytest.approx(expected, rel=1e-15)
    assert hits == "1"
    value, misses, inner = output(USE, tmp_path)
    assert float(value) == pytest.approx(expected, rel=1e-15)
    assert misses == "0"
    assert float(inner) == pytest.approx(30.0, rel=1e-15)


def test_meanings_of_operators_are_looked_up_once(monkeypatch):
    looked_up = []
    original = types.Function.get_call_type

    def counted(self, context, arguments, keywords):
        looked_up.append((self.typing_key, tuple(arguments)))
        return original(self, context, arguments, keywords)

    def polynomial(x, coefficients):
        return coefficients[0] + x * (coefficients[1] + x * (coefficients[2] + x * (coefficients[3] + x / 3)))

    monkeypatch.setattr(types.Function, "get_call_type", counted)
    with remembered_operators():
        compiled = njit(polynomial)
        assert compiled(2.0, np.arange(4.0)) == pytest.approx(0 + 2 * (1 + 2 * (2 + 2 * (3 + 2 / 3))), rel=1e-15)
    assert types.Function.get_call_type is counted
    scalars = [call for call in looked_up if all(isinstance(a, types.Number) for a in call[1])]
    assert scalars
    assert len(scalars) == len(set(scalars))


def test_what_has_no_meaning_stays_an_error():
    with remembered_operators():
        for _ in range(2):
            with pytest.raises(TypingError, match="No implementation of function"):
                njit(lambda x: x @ x)(2.0)
