"""Fixtures that many tests share: a build cache of the test run's own, and modules that are built once."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings
from interpreted import Interpreted

from codegen.compiler import build
from codegen.load import GeneratedModule, load

# Machines are shared: a slow draw says nothing about the code, and timings are never a verdict.
settings.register_profile("shared", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("shared")

PROBLEMS = Path(__file__).parent.parent / "problems"


@pytest.fixture(scope="session", autouse=True)
def cache_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where builds of this run are cached, by all of its worker processes together."""
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "build-cache"
    os.environ["CODEGEN_CACHE_DIR"] = str(folder)
    return folder


@pytest.fixture(scope="session")
def orbital_transfer(cache_folder: Path) -> GeneratedModule:
    return load(build(PROBLEMS / "orbital_transfer.py").path)


@pytest.fixture(scope="session")
def pendulum(cache_folder: Path) -> GeneratedModule:
    """The implicit midpoint rule."""
    return load(build(PROBLEMS / "pendulum.py").path)


@pytest.fixture(scope="session")
def explicit_pendulum(cache_folder: Path) -> GeneratedModule:
    return load(build(PROBLEMS / "pendulum.py", scheme="stormer-verlet").path)


@pytest.fixture(scope="session")
def interpreted(cache_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Interpreted:
    """Makes uncompiled modules: `interpreted("orbital_transfer", scheme="trapezoidal")`."""
    return Interpreted(tmp_path_factory.mktemp("problems"), PROBLEMS)
