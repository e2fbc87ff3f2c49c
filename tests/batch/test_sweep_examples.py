"""The site's examples of other programs around sweeps, as they stand there; skipped where those are not installed."""

from __future__ import annotations

import re

import numpy as np
import pytest
from conftest import PROBLEMS

import codegen

PAGE = PROBLEMS.parent / "docs" / "guide" / "sweeps.md"
LIMITS = {"r1": (4.5, 6.5), "m": (90.0, 110.0)}


def example(of: str) -> str:
    """The block of Python in the page that imports a package."""
    blocks = re.findall(r"^```python\n(.*?)^```$", PAGE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    (found,) = (block for block in blocks if re.search(rf"^(import|from) {of}\b", block, re.MULTILINE))
    return found


@pytest.fixture
def names(orbital_transfer, monkeypatch):
    """What the blocks have before them: imports, and the function of costs, in the folder of the checkout."""
    monkeypatch.chdir(PROBLEMS.parent)
    found = {"codegen": codegen, "numpy": np}
    exec(example("scipy.optimize").partition("\n\n\ndifferential_evolution(")[0], found)
    return found


def test_salib(names, orbital_transfer):
    """Thrust is in proportion to mass, so that the cost is m^2 f(r1): indices are integrals over one variable each."""
    pytest.importorskip("SALib")
    exec(example("SALib"), names)
    places, weights = np.polynomial.legendre.leggauss(12)
    r1, m = ((low + high) / 2 + (high - low) / 2 * places for low, high in LIMITS.values())
    f = np.array([orbital_transfer.solve(30, r1=value, m=1.0).cost for value in r1])

    def mean(values):
        return weights @ values / 2

    whole = mean(m**4) * mean(f**2) - (mean(m**2) * mean(f)) ** 2
    first = [mean(m**2) ** 2 * (mean(f**2) - mean(f) ** 2), mean(f) ** 2 * (mean(m**4) - mean(m**2) ** 2)]
    total = [whole - first[1], whole - first[0]]
    np.testing.assert_allclose(names["indices"]["S1"], np.divide(first, whole), atol=0.01)
    np.testing.assert_allclose(names["indices"]["ST"], np.divide(total, whole), atol=0.01)


def test_optuna(names, orbital_transfer):
    """A satellite that stays where it is, r1 = r0 = 5, needs no thrust."""
    optuna = pytest.importorskip("optuna")
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    exec(example("optuna").replace("create_study()", "create_study(sampler=optuna.samplers.TPESampler(seed=1))"), names)
    study = names["study"]
    assert len(study.trials) == 200
    assert study.best_params["r1"] == pytest.approx(5.0, abs=0.1)
    for trial in (study.best_trial, study.trials[0]):
        assert trial.value == pytest.approx(orbital_transfer.solve(30, **trial.params).cost, rel=1e-9, abs=1e-12)
