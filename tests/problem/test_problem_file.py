"""Reading problem files: the gallery, malformed files and arguments, and what may not be left behind."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from malformed import MALFORMED
from malformed.templates import PRELUDE, Malformed, file_text, first_order, group, optimal, simulation
from refused_files import PROBLEMS, refusal

from codegen.discretise.model.from_problem import load_problem
from codegen.errors import ProblemFileError
from codegen.problem.sources import input_digest


@pytest.mark.parametrize("case", MALFORMED, ids=lambda case: case.id)
def test_malformed_file_is_refused_in_one_line(case: Malformed, tmp_path: Path) -> None:
    error = refusal(case.write(tmp_path))
    assert type(error) is case.error
    assert case.fragment in str(error)


def test_malformed_table_is_large_and_has_unique_ids() -> None:
    assert len({case.id for case in MALFORMED}) == len(MALFORMED) >= 200


@pytest.mark.parametrize("text", [simulation(), optimal()])
def test_templates_of_malformed_files_are_sound(text: str, tmp_path: Path) -> None:
    file = tmp_path / "sound.py"
    file.write_text(text)
    model = load_problem(file)
    assert (model.name, model.title, str(model.function)) == ("sound", "A malformed problem.", "dq**2/2 - q**2/2")


@pytest.mark.parametrize(("text", "coordinates"), [(first_order(), "x v"), (group(), "x y")])
def test_templates_of_malformed_conditions_are_sound(text: str, coordinates: str, tmp_path: Path) -> None:
    file = tmp_path / "sound.py"
    file.write_text(text)
    assert " ".join(map(str, load_problem(file).coordinates)) == coordinates


@pytest.mark.parametrize(
    ("content", "fragment"),
    [
        (b"\x93NUMPY\x01\x00v\x00\xff\xfe", "not text"),
        (b'"""Latin \xe9."""\n', "not text"),
        (b"# coding: klingon\n", "not text"),
        (b"\x00" * 100, "broken.py"),
    ],
)
def test_binary_garbage_is_refused(content: bytes, fragment: str, tmp_path: Path) -> None:
    file = tmp_path / "broken.py"
    file.write_bytes(content)
    assert fragment in str(refusal(file))
    if fragment == "not text":
        with pytest.raises(ProblemFileError, match=fragment):
            input_digest(file, {})


@pytest.mark.parametrize(
    ("name", "fragment"),
    [
        ("missing.py", "no such file"),
        ("missing/file.py", "no such file"),
        ("folder.py", "is a directory"),
        ("notes.txt", "not a Python file"),
        ("pipe.py", "not a Python file"),
        ("two words.py", "cannot name a module"),
        ("2d.py", "cannot name a module"),
        ("lambda.py", "cannot name a module"),
        ("a" * 300 + ".py", "cannot be read"),
        ("null\0byte.py", ""),
    ],
)
def test_paths_that_are_no_problem_file(name: str, fragment: str, tmp_path: Path) -> None:
    (tmp_path / "folder.py").mkdir()
    os.mkfifo(tmp_path / "pipe.py")
    for present in ("notes.txt", "two words.py", "2d.py", "lambda.py"):
        (tmp_path / present).write_text(simulation())
    with pytest.raises(ProblemFileError) as caught:
        load_problem(tmp_path / name)
    assert fragment in str(caught.value)
    assert "\n" not in str(caught.value)


def test_unreadable_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "secret.py"
    file.write_text(simulation())

    def refuse(_: Path) -> bytes:
        raise PermissionError(13, "Permission denied")

    # Taking the permission away would not stop the superuser, as whom tests often run.
    monkeypatch.setattr(Path, "read_bytes", refuse)
    assert "Permission denied" in str(refusal(file))


@pytest.mark.parametrize("file", sorted(PROBLEMS.glob("*.py")), ids=lambda file: file.stem)
def test_gallery_loads_alike_each_time(file: Path) -> None:
    assert load_problem(file) == load_problem(file)


def test_file_leaves_nothing_behind(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "package").mkdir()
    (tmp_path / "package" / "__init__.py").write_text("")
    (tmp_path / "package" / "part.py").write_text("STIFFNESS = 2\n")
    helper, file = tmp_path / "helper.py", tmp_path / "user.py"
    helper.write_text("LENGTH = 3\n")
    body = "import late\nprint('hello')\nq, dq = coordinate('q')\nconstant = late.L * part.STIFFNESS + Local().mass\n"
    (tmp_path / "late.py").write_text("from helper import LENGTH as L\n")
    local = "from dataclasses import dataclass\n\n@dataclass\nclass Local:\n    mass: 'int' = 1\n\n\n"
    file.write_text(
        file_text(body + "return Simulate(lagrangian=constant*dq**2, duration=1, start={q: 0, dq: 0})").replace(
            PRELUDE, PRELUDE + "from package import part\n" + local
        )
    )
    load_problem(PROBLEMS / "pendulum.py")
    modules, path, bytecode = set(sys.modules), list(sys.path), sys.dont_write_bytecode
    assert str(load_problem(file).function) == "7*dq**2"
    helper.write_text("LENGTH = 33\n")
    assert str(load_problem(file).function) == "67*dq**2"
    assert capsys.readouterr().out == ""
    assert (set(sys.modules), sys.path, sys.dont_write_bytecode) == (modules, path, bytecode)
    assert not list(tmp_path.rglob("__pycache__"))


def test_file_may_be_called_like_a_library(tmp_path: Path) -> None:
    file = tmp_path / "sympy.py"
    file.write_text(simulation())
    assert load_problem(file).name == "sympy"


def test_input_digest_sees_every_input_and_no_order(tmp_path: Path) -> None:
    file = tmp_path / "problem.py"
    file.write_text("x = 1\n")
    digest = input_digest(file, {"a": "1", "b": "2"}, "midpoint")
    assert len(digest) == 64
    assert digest == input_digest(file, {"b": "2", "a": "1"}, "midpoint")
    others = [
        input_digest(file, {"a": "1", "b": "2"}),
        input_digest(file, {"a": "1", "b": "2"}, "mid", "point"),
        input_digest(file, {"a": "1", "b": "2"}, "trapezoidal"),
        input_digest(file, {"a": "1b", "": "2"}, "midpoint"),
        input_digest(file, {}, "a", "1", "b", "2", "midpoint"),
        input_digest(file, {"a": "1"}, "b", "2", "midpoint"),
    ]
    file.write_bytes(b"x = 1\r\n")
    assert digest == input_digest(file, {"a": "1", "b": "2"}, "midpoint")
    file.write_text("x = 2\n")
    others.append(input_digest(file, {"a": "1", "b": "2"}, "midpoint"))
    assert len({digest, *others}) == 1 + len(others)


def test_import_and_digest_need_neither_sympy_nor_numba() -> None:
    program = (
        "import sys, pathlib, codegen.problem.sources as p, codegen.problem.sources as s\n"
        "p.parse_arguments(['a=1']), s.input_digest(pathlib.Path(sys.argv[1]), {})\n"
        "print(sorted({'sympy', 'numba', 'numpy', 'scipy'} & set(sys.modules)))"
    )
    command = [sys.executable, "-c", program, str(PROBLEMS / "pendulum.py")]
    result = subprocess.run(command, capture_output=True, text=True, check=True)
    assert result.stdout == "[]\n"
