"""What identifies an object in the build cache: the same text in every process, another one for another problem."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
from pathlib import Path

import pytest
import sympy
from written_objects import FILES, control, object_of

import codegen
from codegen import CodegenError, coordinate, parameters
from codegen.errors import ArgumentError, ExpressionError
from codegen.problem.description import described, quantities_in
from codegen.problem.sources import input_digest, source_of

DIGESTS = """
import sys
sys.path.insert(0, sys.argv[1])
from written_objects import FILES, object_of
from codegen.problem.sources import input_digest
for file in FILES:
    print(file.stem, input_digest(object_of(file), {}))
"""


def digests(seed: str) -> list[str]:
    """What identifies every problem of the gallery as an object, in a process with another hash seed."""
    words = [sys.executable, "-c", DIGESTS, str(Path(__file__).parents[1])]
    environment = {**os.environ, "PYTHONHASHSEED": seed}
    done = subprocess.run(words, capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


@pytest.mark.slow
def test_every_problem_of_the_gallery_is_the_same_in_processes_of_other_hash_seeds():
    found = digests("1")
    assert [line.split()[0] for line in found] == [file.stem for file in FILES]
    assert digests("2") == found


def test_no_two_problems_of_the_gallery_are_the_same():
    assert len({described(object_of(file).problem) for file in FILES[:12]}) == 12


def test_symbols_that_were_declared_otherwise_or_elsewhere_change_nothing():
    first = described(control())
    coordinate("something_else")
    assert described(control()) == first


CHANGES = {
    "a value of a parameter": {"m": 3.0},
    "an end": {"end": lambda x, v, u, m: {x: 2, v: 0}},
    "an end in another order": {"end": lambda x, v, u, m: {v: 0, x: 1}},
    "a type of number": {"end": lambda x, v, u, m: {x: 1.0, v: 0}},
    "a type of number in an expression": {"cost": lambda x, v, u, m: 1.0 * u**2},
    "a fraction": {"cost": lambda x, v, u, m: u**2 / 3},
    "a decimal": {"cost": lambda x, v, u, m: u**2 * (1 / 3)},
    "a path": {"path": lambda x, v, u, m: [u <= 9]},
    "a named path": {"path": lambda x, v, u, m: {"power": u <= 9}},
    "a strict path": {"path": lambda x, v, u, m: [u < 9]},
    "a bound": {"bounds": lambda x, v, u, m: {u: (None, 9)}},
    "a delay": {"cost": lambda x, v, u, m: u**2 + u.delayed(0.5) ** 2},
    "another delay": {"cost": lambda x, v, u, m: u**2 + u.delayed(0.25) ** 2},
    "a function": {"cost": lambda x, v, u, m: u**2 + sympy.cos(x)},
    "another function": {"cost": lambda x, v, u, m: u**2 + sympy.sin(x)},
    "steps": {"steps": lambda x, v, u, m: 5},
    "a drawing": {"drawing": lambda x, v, u, m: [codegen.drawing.Mass((x, 0), 1)]},
    "a label": {"drawing": lambda x, v, u, m: [codegen.drawing.Mass((x, 0), 1, label="cart")]},
}


def test_whatever_an_author_changes_makes_another_problem():
    import codegen.drawing  # noqa: F401

    texts = {"as it is": described(control()), **{name: described(control(**own)) for name, own in CHANGES.items()}}
    same = {text: name for name, text in texts.items()}
    assert len(same) == len(texts), sorted(set(texts) - set(same.values()))


def test_the_order_of_declaration_counts_since_modules_depend_on_it():
    def two(first: str, second: str) -> str:
        declared = {name: parameters(**{name: 1.0})[0] for name in (first, second)}
        return described(control(cost=lambda x, v, u, m: u**2 + declared["a"] * declared["b"]))

    assert two("a", "b") != two("b", "a")


def test_a_shared_part_is_written_once_however_often_it_occurs():
    x, _ = coordinate("x")
    big = x
    for _ in range(60):  # as a tree it has 2^60 leaves
        big = sympy.sin(big) + sympy.cos(big)
    assert len(described(control(cost=lambda *symbols: big))) < 20_000
    assert x in quantities_in(control(cost=lambda *symbols: big))


def test_digest_knows_the_title_and_the_text():
    one = source_of(control(), "one")
    assert input_digest(one, {}) == input_digest(source_of(control(), "one"), {})
    assert input_digest(one, {}) != input_digest(source_of(control(), "one", "Another title"), {})


@pytest.mark.parametrize("name", ["two words", "class", "", 3])
def test_a_name_is_an_identifier(name):
    with pytest.raises(ArgumentError, match="cannot name a module; give a Python identifier"):
        source_of(control(), name)


def test_what_is_no_problem_is_refused():
    with pytest.raises(ArgumentError, match="a problem is no int"):
        source_of(3)
    with pytest.raises(ArgumentError, match="a name or title beside a file"):
        source_of("pendulum.py", "other")
    with pytest.raises(ArgumentError, match="give one line of text"):
        source_of(control(), "one", "two\nlines")


def test_a_part_that_no_problem_may_have_is_named_with_its_place():
    with pytest.raises(ExpressionError, match=r"^arm: Control.cost is a object; give numbers"):
        source_of(control(cost=lambda *symbols: object()), "arm")


def test_an_object_takes_no_arguments():
    with pytest.raises(ArgumentError, match="arm: no argument m, since the problem is an object"):
        source_of(control(), "arm").written({"m": "1"})


def test_problems_survive_a_pickle_with_all_that_symbols_know():
    problem = control(cost=lambda x, v, u, m: u**2 + u.delayed(0.5) ** 2 + m)
    again = pickle.loads(pickle.dumps(problem))
    assert again == problem
    assert described(again) == described(problem)
    (x,) = again.force
    assert x.partner.partner is x
    assert {symbol.name for symbol in quantities_in(again)} >= {"x", "dx", "u", "m", "u.delayed(1/2)"}


def test_symbols_of_another_process_are_no_symbols_of_this_one(tmp_path):
    """Both count declarations, so that equal numbers would make equal symbols of other values."""
    code = "import pickle, sys, codegen; sys.stdout.buffer.write(pickle.dumps(codegen.parameters(m=1.0)[0]))"
    found = [subprocess.run([sys.executable, "-c", code], capture_output=True, check=True).stdout for _ in range(2)]
    one, other = map(pickle.loads, found)
    assert (one.name, one.value) == (other.name, other.value) == ("m", 1.0)
    assert one != other


@pytest.mark.parametrize("wrong", [lambda *_: sympy.Symbol("y"), lambda x, v, u, m: "u**2"])
def test_errors_begin_with_the_name_of_the_object(wrong):
    from codegen.discretise.model.from_problem import load_problem

    with pytest.raises(CodegenError, match=r"^arm: "):
        load_problem(source_of(control(cost=wrong), "arm"))
