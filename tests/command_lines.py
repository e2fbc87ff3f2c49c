"""Running commands in this process, and what a refusal looks like."""

from __future__ import annotations

from conftest import PROBLEMS
from typer.testing import CliRunner

from codegen.cli import main

ORBIT, PENDULUM = str(PROBLEMS / "orbital_transfer.py"), str(PROBLEMS / "pendulum.py")


def run(*words):
    return CliRunner().invoke(main, [str(word) for word in words])


def contents(folder):
    """Every file below a folder with its bytes."""
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def assert_refused(result, *fragments):
    """Exit status 2, one line on stderr, nothing on stdout."""
    assert result.exit_code == 2, result.output
    assert result.stdout == ""
    assert result.stderr.startswith("codegen: error: ")
    assert result.stderr.count("\n") == 1
    assert result.stderr.endswith("\n")
    assert "Traceback" not in result.stderr
    for fragment in fragments:
        assert fragment in result.stderr
