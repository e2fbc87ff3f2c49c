"""Operations are packed in what a module has compiled, wherever that is done, and in nothing else."""

from concurrent.futures import ThreadPoolExecutor
from threading import Barrier

import numpy as np
import pytest
from golden import text_of
from interpreted import config as interpreted_config
from interpreted import without_compilation
from numba import config, njit

from codegen.runtime.packing import packed_operations


def products(x, y):
    """Four neighbours that one instruction can multiply."""
    a, b, c, d = x[0] * y[0], x[1] * y[1], x[2] * y[2], x[3] * y[3]
    y[0] = a
    y[1] = b
    y[2] = c
    y[3] = d


def vectors(function) -> int:
    """How often vectors of numbers stand in the intermediate code of a function that was compiled now."""
    function(np.ones(4), np.ones(4))
    (code,) = function.inspect_llvm().values()
    return code.count(" x double>")


def test_operations_are_packed_inside_the_block_only(monkeypatch):
    monkeypatch.setattr(config, "SLP_VECTORIZE", 0)
    assert vectors(njit(products)) == 0
    with packed_operations():
        assert vectors(njit(products)) > 0
    assert vectors(njit(products)) == 0


def test_what_numba_was_told_holds_again_after_an_error(monkeypatch):
    for before in (0, 1):
        monkeypatch.setattr(config, "SLP_VECTORIZE", before)
        with pytest.raises(ValueError, match="inside"), packed_operations():
            raise ValueError("inside")
        assert before == config.SLP_VECTORIZE


def test_blocks_of_several_modules_may_overlap(interpreted, monkeypatch):
    """Each module has a copy of the text; the option is one, and the last block to end gives it back."""
    modules = [interpreted("pendulum", scheme=scheme) for scheme in ("midpoint", "stormer-verlet")]
    for before in (0, 1):
        monkeypatch.setattr(interpreted_config, "SLP_VECTORIZE", before, raising=False)
        first, second = (module.packed_operations() for module in modules)
        first.__enter__()
        second.__enter__()
        first.__exit__(None, None, None)
        assert interpreted_config.SLP_VECTORIZE == 1
        second.__exit__(None, None, None)
        assert before == interpreted_config.SLP_VECTORIZE


def test_what_a_user_sets_meanwhile_holds(monkeypatch):
    monkeypatch.setattr(config, "SLP_VECTORIZE", 1)
    with packed_operations():
        config.SLP_VECTORIZE = 0
    assert config.SLP_VECTORIZE == 0


def test_threads_that_solve_at_once_leave_the_option_as_it_was(interpreted, monkeypatch):
    module = interpreted("pendulum", scheme="stormer-verlet")
    monkeypatch.setattr(interpreted_config, "SLP_VECTORIZE", 0, raising=False)
    inside, own = Barrier(4), module.integrate

    def together(*arguments):
        inside.wait(60)  # all are inside at once, and end in any order
        return own(*arguments)

    monkeypatch.setattr(module, "integrate", together)
    with ThreadPoolExecutor(4) as pool:
        assert {solution.status for solution in pool.map(module.solve, [100, 200, 300, 400])} == {"solved"}
    assert interpreted_config.SLP_VECTORIZE == 0


@pytest.mark.parametrize(
    ("name", "inside"),
    [
        ("hovercraft", "optimise"), ("bryson_denham", "optimise"), ("pendulum", "integrate"),
        ("lennard_jones_stormer_verlet", "integrate"),
    ],
)  # fmt: skip
def test_a_module_packs_what_its_solve_compiles(name, inside, monkeypatch):
    """Whatever environment it is solved in."""
    module = without_compilation(text_of(f"{name}.py"))
    monkeypatch.setattr(interpreted_config, "SLP_VECTORIZE", 0, raising=False)
    found, own = [], getattr(module, inside)

    def noted(*arguments):
        found.append(interpreted_config.SLP_VECTORIZE)
        return own(*arguments)

    setattr(module, inside, noted)
    module.solve(steps=4)
    assert found == [1]
    assert interpreted_config.SLP_VECTORIZE == 0
