"""Fixtures that many tests share: a build cache of the test run's own, and modules that are built once."""

from __future__ import annotations

import fcntl
import gc
import os
from collections.abc import Iterator
from contextlib import nullcontext
from functools import lru_cache

# Threads of linear algebra wait for each other in busy loops: two workers with two each take several times as long.
# CODEGEN_TEST_THREADS=2 tries them all the same: no result may depend on it.
os.environ.update(
    dict.fromkeys(
        ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), os.environ.get("CODEGEN_TEST_THREADS", "1")
    )
)

from pathlib import Path

import numpy as np
import pytest
import typer.testing
from compiled_modules import compiled, one_system, served_builds
from hypothesis import HealthCheck, settings
from interpreted import Interpreted, all_uncompiled
from registered_images import SHAPE

from codegen.problem.points import read_points
from codegen.registration import register
from codegen.registration.maps import Registration
from codegen.registration.pairs import LandmarkPairs
from codegen.registration.solver import FlowModule, registration_module
from codegen.solving.compiler import build
from codegen.solving.loading import GeneratedModule

# Machines are shared: a slow draw says nothing about the code, and timings are never a verdict.
settings.register_profile("shared", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("shared")

# CliRunner makes the parsers of all commands anew in every call, which takes longer than most calls here.
typer.testing._get_command = lru_cache(typer.testing._get_command)

PROBLEMS = Path(__file__).parent.parent / "problems"


FAST = frozenset(
    "convergence_test newton_steps terms sample_points shapes printer termination phase_programs images"
    " landmark_formats quantities pairs_and_frame first_order_programs inequalities output dense_assembly zeros"
    " bodies least_action packing drawing scene large_constants general ends_and_bodies holonomic_constraints copies"
    " pairwise orders legendre specialise set_values relations model model_of_bodies problem_file phase_checks"
    " nonsmooth_costs path_modes damage damage_beyond_kernels phase_solutions newton filter import_graph batch solver"
    " refinement limits tasks delays segments inner_times samples damaged_samples estimates measured sensitivities"
    " sweep_cases sweep_continuation worker_processes sweep_jumps scattered_jumps sweep_figure sweep_sensitivities"
    " pareto first_order tornado shift controller closed_loop refused_controllers controller_delay preparation site"
    " prose thesis warm_start barrier polynomials both_sides journal tally columns".split()
)
"""Files of tests that compile nothing, or next to nothing: symbols, texts, and kernels that the interpreter runs."""

ONE_SYSTEM = frozenset(
    "rotations contact rolling degenerate_lagrangians stage_bounds events constrained_motions"
    " constrained_phases".split()
)
"""Files of tests on the mathematics of many problems; others test the machine code that a build makes."""

OWN_PROCESSES = frozenset("processes compilation machine_code linking faults specialised refusals".split())
"""Files of tests on the processes that compile, which are started as users start them."""


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Import no other files of tests where `-m fast` is all that is asked for."""
    is_other = collection_path.suffix == ".py" and collection_path.stem.removeprefix("test_") not in FAST
    return True if is_other and config.option.markexpr == "fast" else None


def pytest_collection_finish() -> None:
    """Look for cyclic garbage less often, as builds do, and not among what has been imported and collected."""
    gc.freeze()
    gc.set_threshold(100_000, 10, 10)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests that `pytest -m fast` runs."""
    for item in items:
        if item.path.stem.removeprefix("test_") in FAST and not item.get_closest_marker("slow"):
            item.add_marker("fast")


@pytest.fixture(scope="session", autouse=True)
def cache_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where builds of this run are cached, by all of its worker processes together.

    CODEGEN_TEST_CACHE names a folder that runs share, under several linear algebra libraries for example.
    """
    base = tmp_path_factory.getbasetemp()
    own = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "build-cache"
    folder = Path(os.environ.get("CODEGEN_TEST_CACHE") or own)
    os.environ["CODEGEN_CACHE_DIR"] = str(folder)
    os.chdir(tmp_path_factory.mktemp("elsewhere"))  # beside ./generated a module would be compiled once more
    return folder


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty working directory."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="session")
def orbital_transfer(cache_folder: Path) -> GeneratedModule:
    return compiled(build(PROBLEMS / "orbital_transfer.py").path)


@pytest.fixture(scope="session")
def pendulum(cache_folder: Path) -> GeneratedModule:
    """The implicit midpoint rule."""
    return compiled(build(PROBLEMS / "pendulum.py").path)


@pytest.fixture(scope="session")
def explicit_pendulum(cache_folder: Path) -> GeneratedModule:
    return compiled(build(PROBLEMS / "pendulum.py", scheme="stormer-verlet").path)


@pytest.fixture(scope="session")
def interpreted(cache_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Interpreted:
    """Makes uncompiled modules: `interpreted("orbital_transfer", scheme="trapezoidal")`."""
    return Interpreted(tmp_path_factory.mktemp("problems"), PROBLEMS)


@pytest.fixture
def uncompiled(cache_folder: Path) -> Iterator[None]:
    """Let commands run generated modules by the interpreter, where NaN and infinity come without warnings."""
    with all_uncompiled():
        yield


@pytest.fixture(scope="session")
def solver(cache_folder: Path) -> FlowModule:
    """The compiled solver of registrations, which one worker process compiles and all use."""
    cache_folder.mkdir(parents=True, exist_ok=True)
    with (cache_folder / "registration.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        return registration_module()


@pytest.fixture(scope="session")
def space_solver(solver: FlowModule, cache_folder: Path) -> FlowModule:
    """That of volumes."""
    with (cache_folder / "registration.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        return registration_module(dimension=3)


@pytest.fixture(scope="session")
def pairs() -> LandmarkPairs:
    """Every fifth landmark of the trilobites, in an image of 120 x 160 pixels."""
    points = read_points(PROBLEMS / "data" / "trilobite40.csv", 2)
    return LandmarkPairs(*(np.array([79.5, 59.5]) + 70.0 * p[::5] for p in (points.start, points.target)))


@pytest.fixture(scope="session")
def registration(solver: FlowModule, pairs: LandmarkPairs) -> Registration:
    return register(pairs, SHAPE)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    """Let builds compile in processes that wait for them, and those of files in ONE_SYSTEM no linear system."""
    name = item.path.stem.removeprefix("test_")
    with (
        nullcontext() if name in OWN_PROCESSES else served_builds(),
        one_system() if name in ONE_SYSTEM else nullcontext(),
    ):
        return (yield)
