"""Inner functions that numba makes no machine code of, and that what it compiles with them is the same."""

import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from numba import njit

from codegen.runtime import linking

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

LINK = """
import sys
import numpy as np
from numba import njit
from codegen.runtime import linking
sys.path.insert(0, sys.argv[1])
njit(lambda x: x)(0.0)
VALUES = np.array([1.0, 2.0, 3.0, 4.0])

def linked_module(name, are_kept):
    module = __import__(name)
    linking.link_inner_functions([module.power_sum, module.ratio])
    for function in (module.power_sum, module.ratio) if are_kept else ():
        function.enable_caching()
    return module
"""

COMPILE = (
    LINK
    + """
linked = linked_module("linked", sys.argv[2] == "kept")
print(linked.outer(VALUES))
print(*[len(f.signatures) for f in (linked.power_sum, linked.ratio, linked.outer)])
print(*[f.overloads[f.signatures[0]].library.is_inner for f in (linked.power_sum, linked.ratio, linked.outer)])
"""
)

COMPILE_PLAINLY = (
    LINK
    + """
linking.TRIED = (0, 1), (0, 2)
linked = linked_module("linked", False)
print(linked.outer(VALUES))
print(any("Linked" in type(f.overloads[f.signatures[0]].library).__name__ for f in (linked.power_sum, linked.outer)))
"""
)

COMPILE_BOTH = (
    LINK
    + """
modules = [linked_module(name, True) for name in ("linked", "second")]
linked_module("second", True)
print(*[module.outer(VALUES) for module in modules])
for module in modules:
    print(*[f.overloads[f.signatures[0]].library.is_inner for f in (module.ratio, module.outer)])
"""
)

AGAIN = (
    LINK
    + """
linked = linked_module("linked", True)
print(linked.outer(VALUES), sum(linked.outer.stats.cache_hits.values()))
"""
)

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


@pytest.mark.parametrize("kept", ["kept", "linked alone"])
def test_functions_that_only_compiled_ones_call_have_code_in_their_callers_alone(tmp_path, kept):
    """Also where their intermediate code is kept on the disk."""
    (tmp_path / "linked.py").write_text(MODULE)
    expected = (1 + 4 + 9 + 16) / (1 + 8 + 27) + (1 + 2 + 3)
    value, *rest = output(COMPILE, tmp_path, kept)
    assert float(value) == pytest.approx(expected, rel=1e-15)
    assert rest == ["1", "1", "1", "True", "True", "False"]  # one signature each; the last is machine code
    value, hits = output(AGAIN, tmp_path)  # one process that compiles may need what another one has compiled
    assert float(value) == pytest.approx(expected, rel=1e-15)
    assert hits == "1"
    value, misses, inner = output(USE, tmp_path)
    assert float(value) == pytest.approx(expected, rel=1e-15)
    assert misses == "0"
    assert float(inner) == pytest.approx(30.0, rel=1e-15)


def test_functions_are_linked_with_the_numba_that_is_installed():
    """Fails where numba has changed: builds then take twice as long, and the versions allowed are to be looked at."""
    assert linking.applies([njit(lambda x: x)])


def test_the_versions_that_were_tried_are_those_that_are_allowed():
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"]
    oldest, (major, minor) = linking.TRIED
    wanted = f"numba>={oldest[0]}.{oldest[1]},<{major}.{minor + 1}"
    assert wanted in project["dependencies"]


@pytest.mark.parametrize("version", ["0.60.0", "0.69.0", "0.69.0dev0+12.gabc", "1.0.0", "unknown"])
def test_functions_of_a_numba_that_was_not_tried_are_not_linked(version):
    assert not linking.applies([], version)


class Lacking:
    """Something of numba without one of its attributes."""

    def __init__(self, whole, lacked):
        self._whole, self._lacked = whole, lacked

    def __getattr__(self, asked):
        if asked == self._lacked:
            raise AttributeError(asked)
        return getattr(self._whole, asked)


@pytest.mark.parametrize("name", ["_library_class", "set_env", "_engine", "create_library"])
def test_functions_are_not_linked_where_numba_s_generator_lacks_what_that_needs(name, monkeypatch):
    generator = linking._generator()
    for lacked, expected in (("nothing", True), (name, False)):
        monkeypatch.setattr(linking, "_generator", lambda lacked=lacked: Lacking(generator, lacked))
        assert linking.applies([]) == expected


@pytest.mark.parametrize("name", linking.OF_LIBRARIES)
def test_nor_where_its_class_of_code_does(name, monkeypatch):
    generator = linking._generator()
    monkeypatch.setattr(generator, "_library_class", type("Other", (generator._library_class,), {name: None}))
    assert not linking.applies([])


@pytest.mark.parametrize("name", linking.OF_CODE)
def test_nor_where_the_code_of_a_function_does(name, monkeypatch):
    generator = linking._generator()
    monkeypatch.setattr(generator, "create_library", lambda _: Lacking(generator._library_class(generator, "x"), name))
    assert not linking.applies([])


@pytest.mark.parametrize("name", linking.OF_FUNCTIONS)
def test_nor_where_a_compiled_function_does(name):
    assert linking.applies([Lacking(njit(lambda x: x), "nothing")])
    assert not linking.applies([Lacking(njit(lambda x: x), name)])


def test_one_process_may_compile_several_modules(tmp_path):
    for name in ("linked", "second"):
        (tmp_path / f"{name}.py").write_text(MODULE)
    value, other, *rest = output(COMPILE_BOTH, tmp_path)
    assert float(value) == float(other) == pytest.approx((1 + 4 + 9 + 16) / (1 + 8 + 27) + (1 + 2 + 3), rel=1e-15)
    assert rest == ["True", "False"] * 2


def test_without_linking_the_result_is_the_same(tmp_path):
    values = []
    for program in (COMPILE, COMPILE_PLAINLY):
        folder = tmp_path / str(len(values))
        folder.mkdir()
        (folder / "linked.py").write_text(MODULE)
        value, *rest = output(program, folder, "linked alone")
        values.append(value)
        assert output(USE, folder)[:2] == [value, "0"]
    assert rest == ["False"]
    assert values[0] == values[1]
