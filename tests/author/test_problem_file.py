"""Reading problem files: the gallery, malformed files and arguments, and what may not be left behind."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from malformed import MALFORMED
from malformed_templates import PRELUDE, Malformed, file_text, first_order, group, optimal, simulation

from codegen.author.problem_file import input_digest, parse_arguments
from codegen.errors import ArgumentError, CodegenError, ProblemFileError
from codegen.model.from_file import load_problem

PROBLEMS = Path(__file__).parents[2] / "problems"

TYPED = '''"""Arguments of every type."""

from pathlib import Path
from typing import Annotated, Literal, Optional

from codegen import Simulate, coordinate

RECEIVED = {}


def problem(
    count: int = 1,
    mass: float = 1,
    fast: bool = False,
    label: str = "",
    shape: Literal["disc", "ring", 3] = "disc",
    table: Path = Path("table.csv"),
    limit: Optional[float] = None,
    either: "int | None" = None,
    noted: Annotated[float, "kilograms"] = 1.0,
    plain=2.0,
    listed: list[int] = [],
    untyped=None,
):
    q, dq = coordinate("q")
    print("printed by the problem file")
    raise RuntimeError(repr(dict(locals())))
'''


def received(folder: Path, name: str, text: str) -> str:
    """The representation of what problem() receives for one argument."""
    file = folder / "typed.py"
    file.write_text(TYPED.replace("repr(dict(locals()))", f"repr({name})"))
    with pytest.raises(ProblemFileError) as caught:
        load_problem(file, {name: text})
    return str(caught.value).split("RuntimeError: ")[1].split(";")[0]


def refusal(file: Path, arguments: dict[str, str] | None = None) -> CodegenError:
    with pytest.raises(CodegenError) as caught:
        load_problem(file, arguments or {})
    message = str(caught.value)
    assert message.startswith(str(file))
    assert message.isprintable()
    assert caught.value.remedy
    return caught.value


@pytest.mark.parametrize("case", MALFORMED, ids=lambda case: case.id)
def test_malformed_file_is_refused_in_one_line(case: Malformed, tmp_path: Path) -> None:
    file = tmp_path / "broken.py"
    file.write_text(case.text, encoding="utf-8")
    error = refusal(file)
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


def test_gallery_argument_changes_one_default_only() -> None:
    once = load_problem(PROBLEMS / "orbital_transfer.py")
    twice = load_problem(str(PROBLEMS / "orbital_transfer.py"), {"revolutions": "2"})
    assert dict(zip(map(str, once.parameters), once.defaults, strict=True))["revolutions"] == 1.0
    assert dict(zip(map(str, twice.parameters), twice.defaults, strict=True))["revolutions"] == 2.0
    assert replace(twice, defaults=once.defaults) == once
    assert once.name == "orbital_transfer"
    assert once.title == "Transfer a satellite between two coplanar circular orbits with the least effort."


def test_gallery_argument_changes_form() -> None:
    model = load_problem(PROBLEMS / "pendulum.py", {"form": "lagrangian"})
    assert (model.form, str(model.function)) == ("lagrangian", "dq**2/2 + cos(q)")
    assert load_problem(PROBLEMS / "pendulum.py").form == "hamiltonian"


@pytest.mark.parametrize("file", sorted(PROBLEMS.glob("*.py")), ids=lambda file: file.stem)
def test_gallery_loads_alike_each_time(file: Path) -> None:
    assert load_problem(file) == load_problem(file)


@pytest.mark.parametrize(
    ("arguments", "fragments"),
    [
        ({"revolution": "2"}, ["revolution: no such", "did you mean revolutions?"]),
        ({"colour": "red"}, ["colour: no such", "takes revolutions"]),
        ({"": "2"}, ["no such"]),
        ({"new\nline": "2"}, ["new line"]),
        *(({"revolutions": text}, ["revolutions=", "a finite number"]) for text in ["", "two", "nan", "-inf", "1e999"]),
        *(({"revolutions": text}, ["revolutions=", "a finite number"]) for text in ["1\n2", "1,5", "pi", "0x10", "1j"]),
    ],
)
def test_malformed_arguments_of_the_orbital_transfer(arguments: dict[str, str], fragments: list[str]) -> None:
    error = refusal(PROBLEMS / "orbital_transfer.py", arguments)
    assert type(error) is ArgumentError
    assert all(fragment in str(error) for fragment in fragments)


def test_malformed_arguments_name_what_is_allowed() -> None:
    assert "hamiltonian or lagrangian" in str(refusal(PROBLEMS / "pendulum.py", {"form": "newtonian"}))
    assert "takes no arguments" in str(refusal(PROBLEMS / "linear_pendulum.py", {"form": "hamiltonian"}))


@pytest.mark.parametrize(
    ("name", "text", "value"),
    [
        ("count", "7", "7"),
        ("count", "-3", "-3"),
        ("count", "1e3", "1000"),
        ("mass", "2", "2.0"),
        ("mass", "1e-3", "0.001"),
        ("fast", "true", "True"),
        ("fast", "Off", "False"),
        ("label", "a=b c", "'a=b c'"),
        ("label", "", "''"),
        ("shape", "ring", "'ring'"),
        ("shape", "3", "3"),
        ("table", "data/a.csv", "PosixPath('data/a.csv')"),
        ("limit", "None", "None"),
        ("limit", "2.5", "2.5"),
        ("either", "4", "4"),
        ("noted", "1.5", "1.5"),
        ("plain", "3", "3.0"),
    ],
)
def test_arguments_are_converted_to_their_types(name: str, text: str, value: str, tmp_path: Path) -> None:
    assert received(tmp_path, name, text) == value


@pytest.mark.parametrize(
    ("name", "text", "fragment"),
    [
        ("count", "2.5", "a whole number"),
        ("count", "1e999999999", "a whole number"),
        ("count", "many", "a whole number"),
        ("count", "inf", "a whole number"),
        ("fast", "maybe", "true or false"),
        ("shape", "Ring", "disc or ring or 3"),
        ("table", " ", "a path"),
        ("limit", "nothing", "none or a finite number"),
        ("listed", "1", "annotate listed"),
        ("untyped", "1", "annotate untyped"),
    ],
)
def test_arguments_that_do_not_fit_their_types(name: str, text: str, fragment: str, tmp_path: Path) -> None:
    file = tmp_path / "typed.py"
    file.write_text(TYPED)
    error = refusal(file, {name: text})
    assert type(error) is ArgumentError
    assert name in error.finding
    assert fragment in error.remedy


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


words = st.text(st.characters(exclude_characters="=", exclude_categories=["Cs"]), min_size=1).map(str.strip)


@given(st.dictionaries(words.filter(bool), st.text()))
def test_parse_arguments_inverts_joining(arguments: dict[str, str]) -> None:
    assert parse_arguments([f"{name}={value}" for name, value in arguments.items()]) == arguments


@given(st.lists(st.text()))
def test_parse_arguments_refuses_in_one_line_or_keeps_every_item(items: list[str]) -> None:
    kept, message = items, ""
    try:
        kept = list(parse_arguments(items))
    except ArgumentError as error:
        message = str(error)
    assert len(kept) == len(items)
    assert "\n" not in message


@pytest.mark.parametrize(
    ("items", "fragment"),
    [(["steps"], "'steps'"), (["=3"], "'=3'"), ([""], "''"), ([" = 3"], "name=value"), (["a=1", "a=2"], "a twice")],
)
def test_parse_arguments_refuses(items: list[str], fragment: str) -> None:
    with pytest.raises(ArgumentError, match=fragment):
        parse_arguments(items)


@pytest.fixture(scope="module")
def echo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("echo") / "echo.py"
    signature = "mass: float = 1.0, count: int = 1"
    file.write_text(
        file_text(
            "q, dq = coordinate('q')\nm = parameter('m', mass)\n"
            "return Simulate(lagrangian=dq**2, duration=2**m, start={q: count, dq: 0})",
            signature,
        )
    )
    return file


@given(number=st.floats(-30, 30))
def test_floats_survive_the_command_line(number: float, echo: Path) -> None:
    assert load_problem(echo, {"mass": repr(number)}).defaults == (number,)


@given(number=st.integers(-(10**300), 10**300))
def test_integers_survive_the_command_line(number: int, echo: Path) -> None:
    assert load_problem(echo, {"count": str(number)}).start.positions == (number,)


@given(text=st.text(max_size=8))
def test_any_text_for_a_number_is_read_or_refused_in_one_line(text: str, echo: Path) -> None:
    for name in ("mass", "count"):
        message = ""
        try:
            load_problem(echo, {name: text})
        except CodegenError as error:
            message = str(error)
        assert "\n" not in message


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
        "import sys, pathlib, codegen.author.problem_file as p\n"
        "p.parse_arguments(['a=1']), p.input_digest(pathlib.Path(sys.argv[1]), {})\n"
        "print(sorted({'sympy', 'numba', 'numpy', 'scipy'} & set(sys.modules)))"
    )
    command = [sys.executable, "-c", program, str(PROBLEMS / "pendulum.py")]
    result = subprocess.run(command, capture_output=True, text=True, check=True)
    assert result.stdout == "[]\n"
