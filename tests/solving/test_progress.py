"""Progress of builds that Python code starts: a line on a terminal and in a notebook, and nothing elsewhere."""

from __future__ import annotations

import io
import subprocess
import sys

import pytest
from terminals import on_terminal

from codegen.solving.progress import building, shown_from_call

SCRIPT = """
import sys
import codegen

x, dx = codegen.coordinate("x")
f = codegen.control("f")
problem = codegen.Control(
    lagrangian=dx**2 / 2, force={x: f}, cost=f**2, duration=1, start={x: 0, dx: 0}, end={x: 1, dx: 0}, steps=4
)
way = sys.argv[1]
if way == "solve":
    solution = codegen.solve(problem)
elif way == "compile":
    solution = codegen.compile(problem).solve()
elif way == "controller":
    codegen.Controller(problem, sample=0.1)
else:
    codegen.sweep(problem, {"steps": [4, 5]}, workers=1)
print(way)
"""


@pytest.mark.parametrize("way", ["solve", "compile", "controller", "sweep"])
def test_a_build_is_shown_on_a_terminal_once(tmp_path, way):
    for run in ("cold", "warm"):
        done = on_terminal(way, folder=tmp_path, program=("-c", SCRIPT))
        assert (done.status, done.stdout) == (0, f"{way}\n"), done.screen
        assert ("Deriving" in done.screen) == (run == "cold")


def test_nothing_is_shown_elsewhere(tmp_path, monkeypatch):
    monkeypatch.setenv("CODEGEN_CACHE_DIR", str(tmp_path))
    monkeypatch.setenv("NUMBA_DISABLE_JIT", "1")
    done = subprocess.run([sys.executable, "-c", SCRIPT, "solve"], capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("solve\n", "")


def test_the_line_of_a_notebook_disappears(monkeypatch):
    class OutStream(io.StringIO):
        __module__ = "ipykernel.iostream"

    monkeypatch.setattr(sys, "stderr", OutStream())
    with building("Compiling") as line:
        assert sys.stderr.getvalue() == "\rCompiling ..."
        line.update("Compiling: 1 of 2")
    assert sys.stderr.getvalue().split("\r")[2:] == ["Compiling: 1 of 2", " " * 17, ""]


def test_a_text_is_shown_from_the_first_call_on():
    shown = []

    class Shown:
        def __enter__(self):
            shown.append("begin")

        def __exit__(self, *error):
            shown.append("end")

    with shown_from_call(lambda what: Shown(), "Deriving") as show:
        assert shown == []
        show()
        show()
        assert shown == ["begin"]
    assert shown == ["begin", "end"]
    with shown_from_call(lambda what: Shown(), "Deriving"):
        pass
    assert shown == ["begin", "end"]
