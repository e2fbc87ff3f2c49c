"""Arguments of problem files: types, `--set`, and what cannot be read."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from malformed.templates import file_text
from refused_files import PROBLEMS, refusal

from codegen.discretise.model.from_problem import load_problem
from codegen.errors import ArgumentError, CodegenError, ProblemFileError
from codegen.problem.sources import parse_arguments

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


words = st.text(st.characters(exclude_characters="=", exclude_categories=["Cs"]), min_size=1).map(str.strip)


@pytest.mark.slow
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


@pytest.mark.slow
@given(number=st.floats(-30, 30))
def test_floats_survive_the_command_line(number: float, echo: Path) -> None:
    assert load_problem(echo, {"mass": repr(number)}).defaults == (number,)


@pytest.mark.slow
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
