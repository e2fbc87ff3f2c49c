"""`codegen new`: problems of the gallery are listed and copied; and the help of all commands has examples."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
import typer
from command_lines import assert_refused, contents, run
from conftest import PROBLEMS

from codegen.cli import COMMANDS, main
from codegen.discretise.model.from_problem import load_problem


def test_without_a_name_all_problems_are_listed(folder):
    done = run("new")
    assert done.exit_code == 0
    names = {path.stem for path in (*PROBLEMS.glob("*.py"), *(PROBLEMS / "published").glob("*.py"))}
    assert names <= set(done.stdout.split())
    assert contents(folder) == {}


def test_a_problem_is_copied(folder):
    assert run("new", "pendulum", "--out", "own").exit_code == 0
    assert (folder / "own" / "pendulum.py").read_bytes() == (PROBLEMS / "pendulum.py").read_bytes()


@pytest.mark.parametrize(("name", "files"), [("gas_oil", ["gas_oil.csv"]), ("predator_prey", ["predator_prey.csv"])])
def test_data_are_copied_and_found(folder, name, files):
    assert run("new", name).exit_code == 0
    assert sorted(path.name for path in (folder / "data").iterdir()) == files
    assert load_problem(folder / f"{name}.py", {}).title


def test_what_exists_is_not_overwritten(folder):
    (folder / "pendulum.py").write_text("precious")
    assert_refused(run("new", "pendulum"), "pendulum.py exists already", "--out")
    assert (folder / "pendulum.py").read_text() == "precious"


def test_an_unknown_name_is_refused_with_close_ones(folder):
    assert_refused(run("new", "pendulun"), "pendulun", "did you mean pendulum")


def test_without_a_command_help_is_shown():
    done = run()
    assert (done.exit_code, done.stderr) == (0, "")
    assert done.stdout == run("--help").stdout
    assert all(f"  {name} " in done.stdout for name in COMMANDS)


@pytest.mark.parametrize("name", COMMANDS)
def test_help_ends_with_examples_that_use_existing_options(name):
    command = typer.main.get_command(main).commands[name]
    *_, block = run(name, "--help").stdout.split("Examples:\n")
    examples = [line.split() for line in block.splitlines() if line.strip()]
    assert 1 <= len(examples) <= 2
    known = {option for parameter in command.params for option in (*parameter.opts, *parameter.secondary_opts)}
    for words in examples:
        assert words[:2] == ["codegen", name]
        assert {word for word in words if word.startswith("--")} <= known


def test_the_shell_completes_commands():
    words = {"COMP_WORDS": "codegen so", "COMP_CWORD": "1", "_CODEGEN_COMPLETE": "complete_bash"}
    done = subprocess.run(
        [sys.executable, "-m", "codegen"], capture_output=True, text=True, env=os.environ | words, check=False
    )
    assert (done.returncode, done.stdout.split(), done.stderr) == (0, ["solve"], "")
