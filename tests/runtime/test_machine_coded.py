"""Interpreted modules that eliminate by machine code of their own text find what the interpreter alone finds."""

from __future__ import annotations

import machine_coded
import pytest
from golden import text_of
from interpreted import without_compilation


@pytest.fixture
def text(cache_folder) -> str:
    return text_of("brachistochrone.py")


def test_they_solve_alike(text, monkeypatch):
    fast = without_compilation(text)
    assert fast.eliminate_rows is machine_coded.functions("symmetric")["eliminate_rows"]
    assert fast.clear is machine_coded.functions("arrays")["clear"]
    monkeypatch.setattr(machine_coded.Switch, "on", False)
    slow = without_compilation(text)
    assert slow.eliminate_rows.__module__ == slow.__name__
    found, expected = fast.solve(6), slow.solve(6)
    assert (found.status, found.iterations) == ("solved", expected.iterations)
    assert found.cost == pytest.approx(expected.cost, rel=1e-13)


def test_what_reads_otherwise_is_interpreted(text):
    assert text.count("negative += 1\n") == 1
    module = without_compilation(text.replace("negative += 1\n", "negative += 2\n"))
    assert module.eliminate_rows.__module__ == module.__name__
    assert without_compilation(text).solve(6, max_iterations=30).status == "solved"
    assert module.solve(6, max_iterations=30).status != "solved"  # nor with 2000, which take long
