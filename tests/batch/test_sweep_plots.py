"""Pictures of sweeps as they are asked for, of what a store or a file has kept."""

from __future__ import annotations

from pathlib import Path

import pytest
from command_lines import ORBIT, PENDULUM, run

WORDS = {
    "lines": (ORBIT, "--vary", "r1=5.9:6.1:5", "--vary", "m=90,100"),
    "failures": (ORBIT, "--vary", "r1=-6,5.9,6,6.1"),
    "map": (ORBIT, "--vary", "r1=5.9:6.1:9", "--vary", "m=90:100:8"),
    "prescribed": (ORBIT, "--vary", "start.r=4.9:5.1:4"),
    "samples": (ORBIT, "--sample", "m=normal(100, 5)", "--cases", "20"),
    "front": (ORBIT, "--vary", "duration=120:140:5", "--vary", "end.phi=6,6.3", "--pareto", "cost,duration"),
    "simulation": (PENDULUM, "--vary", "duration=1,2,3"),
    "simulations": (PENDULUM, "--sample", "duration=uniform(1, 2)", "--cases", "10"),
    "modules": (PENDULUM, "--vary", "form=hamiltonian,lagrangian", "--scheme", "stormer-verlet"),
}


@pytest.mark.parametrize("out", ["s.zarr", "s.nc"])
@pytest.mark.parametrize("name", WORDS)
def test_every_kind_of_sweep_has_its_picture(folder, orbital_transfer, pendulum, explicit_pendulum, name, out):
    done = run("sweep", *WORDS[name], "--steps", 20, "--workers", 1, "--out", out, "--plot", "s.png")
    assert done.exit_code == (name == "failures"), done.output
    assert Path("s.png").stat().st_size > 1000
