"""The compiled solver of registrations, which one worker process compiles and all use."""

from __future__ import annotations

import fcntl
from pathlib import Path

import numpy as np
import pytest

from codegen.points import read_points
from codegen.registration import LandmarkPairs, Registration, register
from codegen.registration.flow import FlowModule
from codegen.registration.solver import registration_module

TRILOBITES = Path(__file__).parents[2] / "problems" / "data" / "trilobite40.csv"
SHAPE = (120, 160)


@pytest.fixture(scope="session")
def solver(cache_folder: Path) -> FlowModule:
    cache_folder.mkdir(parents=True, exist_ok=True)
    with (cache_folder / "registration.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        return registration_module()


@pytest.fixture(scope="session")
def pairs() -> LandmarkPairs:
    """Every fifth landmark of the trilobites, in an image of 120 x 160 pixels."""
    points = read_points(TRILOBITES, 2)
    return LandmarkPairs(*(np.array([79.5, 59.5]) + 70.0 * p[::5] for p in (points.start, points.target)))


@pytest.fixture(scope="session")
def registration(solver: FlowModule, pairs: LandmarkPairs) -> Registration:
    return register(pairs, SHAPE)
