"""Operations are packed in what a module has compiled, wherever that is done, and in nothing else."""

from concurrent.futures import ThreadPoolExecutor
from threading import Barrier
from types import SimpleNamespace

import numpy as np
import pytest
from numba import config, njit

from codegen.runtime import kernels
from codegen.runtime.kernels import packed_operations
from codegen.runtime.search import problem


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


def test_blocks_may_overlap(monkeypatch):
    """The option is one for all, and the last block to end gives it back."""
    for before in (0, 1):
        monkeypatch.setattr(config, "SLP_VECTORIZE", before)
        first, second = packed_operations(), packed_operations()
        first.__enter__()
        second.__enter__()
        first.__exit__(None, None, None)
        assert config.SLP_VECTORIZE == 1
        second.__exit__(None, None, None)
        assert before == config.SLP_VECTORIZE


def test_what_a_user_sets_meanwhile_holds(monkeypatch):
    monkeypatch.setattr(config, "SLP_VECTORIZE", 1)
    with packed_operations():
        config.SLP_VECTORIZE = 0
    assert config.SLP_VECTORIZE == 0


def test_threads_that_are_inside_at_once_leave_the_option_as_it_was(monkeypatch):
    monkeypatch.setattr(config, "SLP_VECTORIZE", 0)
    inside = Barrier(4)

    @packed_operations()
    def seen(_):
        inside.wait(60)  # all are inside at once, and end in any order
        return config.SLP_VECTORIZE

    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(seen, range(8))) == [1] * 8
    assert config.SLP_VECTORIZE == 0


@pytest.mark.parametrize("module", [kernels, problem])
def test_functions_of_modules_are_packed(module, monkeypatch):
    """Whatever environment they are compiled in."""
    found = []

    def noted(*_, **__):
        found.append(config.SLP_VECTORIZE)
        return lambda function: SimpleNamespace(function=function, cache_hits=1)

    def fill(filled):
        """Nothing."""

    monkeypatch.setattr(config, "SLP_VECTORIZE", 0)
    monkeypatch.setattr(kernels, "cfunc", noted)
    made = module.Kernel(fill) if module is kernels else module.Loop(fill)
    assert made.compiled.function is fill
    assert (found, config.SLP_VECTORIZE) == ([1], 0)
