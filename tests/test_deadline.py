"""A derivation that takes too long ends with what is too large, even in the middle of one call."""

import contextlib
import threading
import time
from pathlib import Path

import pytest
import sympy
from typer.testing import CliRunner

from codegen.cli import main
from codegen.emit.deadline import Overdue, Stages, interrupted_after, parts_of
from codegen.emit.naming import Choices
from codegen.errors import SizeError
from codegen.evidence import checks
from codegen.evidence.checks.base import Finding
from codegen.solving import compiler

PROBLEM = """
"A pendulum."
from sympy import cos
from codegen import Simulate, coordinates

def problem():
    (a,), (da,) = coordinates("a")
    return Simulate(lagrangian=da**2 / 2 + cos(a), duration=1, start={a: 1, da: 0}, steps=10)
"""


@pytest.fixture
def file(tmp_path) -> Path:
    path = tmp_path / "swing.py"
    path.write_text(PROBLEM)
    compiler.generate(path, {}, Choices())  # importing what the stages need is not to count
    return path


def for_ever(*_, **__):
    """What looks at no clock."""
    while True:
        sympy.Integer(3) ** 7


@pytest.mark.parametrize(
    ("stage", "said"),
    [
        ("codegen.discretise.transcribe.transcribe", "writing the equations of an interval was not done"),
        ("codegen.emit.differentiation.derivatives", "differentiating the equations of an interval was not done"),
        ("codegen.emit.verify.verify", "verifying the kernels was not done"),
    ],
)
def test_a_stage_that_does_not_end_is_named(file, tmp_path, monkeypatch, stage, said):
    monkeypatch.setenv("CODEGEN_CACHE_DIR", str(tmp_path / "cache"))  # where nothing has been derived
    monkeypatch.setattr(stage, for_ever)
    with pytest.raises(
        SizeError, match=rf"{said} after 2 s .*1 coordinates.*the Lagrangian has \d+ parts.*--time-limit"
    ):
        compiler.build(file, out=tmp_path / "out", time_limit=2)
    assert not (tmp_path / "out").exists()


def test_the_command_says_so_in_one_line(file, tmp_path, monkeypatch):
    monkeypatch.setenv("CODEGEN_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setattr("codegen.emit.differentiation.derivatives", for_ever)
    arguments = ["build", str(file), "--out", str(tmp_path / "out"), "--no-compile", "--time-limit", "1.5"]
    result = CliRunner().invoke(main, arguments)
    assert isinstance(result.exception, SizeError) or result.exit_code == 2
    assert not (tmp_path / "out").exists()


def test_a_handler_for_exceptions_does_not_swallow_the_end():
    begin = time.process_time()
    with pytest.raises(Overdue), interrupted_after(0.2), contextlib.suppress(Exception):  # as parts of sympy have it
        for_ever()
    assert time.process_time() - begin < 5


def test_in_another_thread_the_limit_is_looked_at_between_stages():
    found = []

    def work():
        stages = Stages(0.05)
        try:
            with stages.limited():
                begin = time.process_time()
                while time.process_time() < begin + 0.1:
                    sympy.Integer(3) ** 7
                stages.begin("the next stage")
        except SizeError as error:
            found.append(str(error))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert found[0].startswith(
        "reading and checking the problem file was not done after 0.05 s of processor time; give"
    )


def test_a_check_that_does_not_end_was_not_measured(file, monkeypatch):
    made = compiler.build(file)
    context = checks.context_of(file, {}, Choices(), made.path)

    def endless(_):
        yield Finding("consistency", "a first part", True, "it holds")
        for_ever()

    monkeypatch.setitem(checks.CHECKS, "consistency", checks.Check("consistency", endless))
    first, rest = checks.apply("consistency", context, 0.3)
    assert first.subject == "a first part"
    assert rest.passed
    assert not rest.applies
    assert rest.detail.startswith("not measured: the problem is too large for it, which was not done after 0 s")


def test_equal_parts_count_once():
    x = sympy.Symbol("x")
    assert parts_of(sympy.sin(x) + sympy.sin(x) ** 2) == 5
