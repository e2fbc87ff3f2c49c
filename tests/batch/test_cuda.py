"""Cases on a GPU: numba's simulator runs the device functions and the kernel, the optima are those of the processor."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import codegen
from codegen.errors import ArgumentError, DeviceError

PROBLEMS = Path(__file__).parents[2] / "problems"
KINDS = {
    "orbital_transfer": ({}, 6, "r1", [5.6, 6.0, 6.4]),
    "linear_pendulum": ({}, 8, "end.q", [0.8, 1.2]),
    "cart_pole": ({}, 10, "rod", [0.4, 0.5, 0.6]),
    "goddard_rocket": ({"scheme": "rk4"}, 10, "c", [0.49, 0.51]),
    "bouncing_ball": ({}, 6, "g", [9.7, 9.9]),
    "quadrotor": ({"scheme": "gauss-4"}, 5, "m", [0.9, 1.1]),
    "van_der_pol": ({"scheme": "hermite-simpson"}, 8, "start.x1", [0.9, 1.0]),
    "hovercraft": ({}, 4, "m", [0.9, 1.0]),
}
"""Options of the build, steps, a parameter and its values: equations alone, a linear-quadratic problem, bounds, an
explicit scheme with a free duration, phases, stages, stages with bounds, and several bodies."""
MOTIONS = {
    "pendulum": ({}, 20, 1, "start.p", [0.1, 0.2, 0.3]),
    "pendulum explicitly": ({"scheme": "stormer-verlet"}, 120, 7, "start.p", [0.5, 1.4]),
    "heavy_top": ({}, 6, 1, "m", [0.9, 1.1]),
    "dzhanibekov": ({"scheme": "suzuki-4-of-midpoint"}, 4, 3, "duration", [1.0, 2.0, -1.0]),
}
"""Options of the build, steps, every, a parameter and its values: implicit and explicit steps, rotations, parts."""
SCRIPT = """
import json, sys
import numpy as np
import codegen
from codegen.runtime.cuda import batches as optima
from compiled_modules import one_system, served_builds

class OnDevice:  # an array of another package, which says where its numbers are and is no array of numpy
    def __init__(self, values):
        self.numbers, self.ndim = np.array(values), 1

    @property
    def __cuda_array_interface__(self):
        return self.numbers.__array_interface__


on_device, solve_cases = [], optima.solve_cases

def counted(*arguments):
    solve_cases(*arguments)
    on_device.extend(arguments[7].is_found.tolist())

optima.solve_cases = counted
np.seterr(all="ignore")
served, quick = served_builds(), one_system()
served.__enter__()
quick.__enter__()  # the device has no linear system with the numbers of a problem either
kinds, results = json.loads(sys.argv[1]), {}
for path, options, steps, name, values in kinds:
    solver = codegen.compile(path, **options)
    first, other = (
        codegen.solve_many(solver, {name: values}, steps=steps, executor=executor) for executor in ("threads", "cuda")
    )
    results[path] = [
        first.status.tolist() == other.status.tolist(), first.iterations.tolist() == other.iterations.tolist(),
        float(np.abs(first.unknowns - other.unknowns).max() / np.abs(first.unknowns).max()),
        float(np.abs(first.cost - other.cost).max()), list(on_device),
    ]
    on_device.clear()

for path, name, options, steps, every, parameter, values in json.loads(sys.argv[2]):
    solver = codegen.compile(path, **options)
    first, other = (
        codegen.solve_many(solver, {parameter: values}, steps=steps, every=every, executor=executor)
        for executor in ("threads", "cuda")
    )
    results[f"motions of {name}"] = [
        first.status.tolist(), other.status.tolist(), first.iterations.tolist() == other.iterations.tolist(),
        float(np.nanmax(np.abs(first.path - other.path))), float(np.nanmax(first.residual - other.residual)),
    ]
    kept = codegen.solve_many(
        solver, {parameter: OnDevice(values)}, steps=steps, every=every, executor="cuda", on_device=True
    )
    same = [np.array_equal(getattr(first, own), getattr(kept, own), equal_nan=True) for own in ("q", "p", "energy")]
    data = kept.to_dataset()
    results[f"kept {name}"] = [
        *same, kept.status.tolist() == first.status.tolist(), data.identical(first.to_dataset()),
        kept.path.strides[0] == kept.path.itemsize < first.path.strides[0],
    ]
axes, options = {"r1": [5.6, 6.0, -6.0, 6.4], "m": [90.0, 110.0]}, {"steps": 6, "chunk": 3}
one, other = (codegen.sweep(kinds[0][0], axes, executor=executor, **options) for executor in ("threads", "cuda"))
results["sweep"] = [
    one.status.values.tolist(), other.status.values.tolist(), float(abs(one.q - other.q).max()), len(on_device)
]
axes = {"start.p": [0.3, 1.2], "duration": [1.0, -1.0, 2.0]}
one, other = (
    codegen.sweep(json.loads(sys.argv[2])[0][0], axes, executor=executor, steps=30, every=4, chunk=4)
    for executor in ("threads", "cuda")
)
names = "t q p energy residual iterations status message".split()
results["sweep of motions"] = [name for name in names if not one[name].equals(other[name])]
from numba.cuda.cudadrv.driver import CudaAPIError

axes, counted_cases = {"r1": [5.6, 5.8, 6.0, 6.2, 6.4]}, optima.solve_cases
one = codegen.sweep(kinds[0][0], axes, steps=6)
for kind, error in {"full": CudaAPIError(2, "CUDA_ERROR_OUT_OF_MEMORY"), "interrupted": KeyboardInterrupt()}.items():
    calls, out = [], f"{sys.argv[3]}/{kind}.zarr"

    def ended(*arguments):
        calls.append(arguments)
        if len(calls) == 3:  # of the first case and the first chunk are those before
            raise error
        counted_cases(*arguments)

    optima.solve_cases = ended
    try:
        codegen.sweep(kinds[0][0], axes, executor="cuda", steps=6, chunk=2, out=out)
    except (codegen.CodegenError, codegen.errors.Interrupted) as raised:
        results[f"{kind} sweep"] = [type(raised).__name__, str(raised).replace(out, "OUT")]
    optima.solve_cases = counted_cases
    on_device.clear()
    other = codegen.sweep(kinds[0][0], axes, executor="cuda", steps=6, chunk=2, out=out, resume=True)
    results[f"{kind} sweep"] += [float(abs(one.q - other.q).max()), other.status.values.tolist(), len(on_device)]
optima.free_memory = lambda: 20_000
try:
    codegen.solve_many(kinds[0][0], {"r1": [6.0]}, steps=6, executor="cuda")
except codegen.errors.DeviceError as error:
    results["full"] = str(error)
print(json.dumps(results))
"""


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    """The comparisons of all KINDS, from one process with numba's simulator."""
    kinds = [(str(PROBLEMS / f"{name}.py"), *of_kind) for name, of_kind in KINDS.items()]
    motions = [(f"{PROBLEMS / name.split()[0]}.py", name, *of_kind) for name, of_kind in MOTIONS.items()]
    variables = {"NUMBA_ENABLE_CUDASIM": "1", "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, json.dumps(kinds), json.dumps(motions), str(tmp_path_factory.mktemp("stores"))],
        env=os.environ | variables, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return {Path(path).stem: found for path, found in json.loads(done.stdout.splitlines()[-1]).items()}


@pytest.mark.parametrize("name", KINDS)
def test_the_device_finds_the_optima_of_the_processor(simulated, name):
    same_status, same_iterations, unknowns, cost, on_device = simulated[name]
    assert same_status
    assert same_iterations
    assert unknowns <= 1e-7
    assert cost <= 1e-9
    assert len(on_device) == len(KINDS[name][3])


@pytest.mark.parametrize("name", MOTIONS)
def test_motions_on_the_device_have_the_bits_of_the_processor(simulated, name):
    statuses, on_device, same_iterations, states, residuals = simulated[f"motions of {name}"]
    expected = ["unusable" if value < 0.0 else "solved" for value in MOTIONS[name][4]]
    assert statuses == on_device == expected
    assert same_iterations
    assert states == residuals == 0.0


@pytest.mark.parametrize("name", MOTIONS)
def test_states_stay_on_the_device_on_request(simulated, name):
    """Their layout is the one of the device, with the index of a case last in memory."""
    assert simulated[f"kept {name}"] == [True] * 6


def test_what_stays_on_no_device_is_refused():
    for name, executor in (("pendulum", "threads"), ("orbital_transfer", "threads")):
        with pytest.raises(ArgumentError, match="on_device keeps states of simulations on a GPU"):
            codegen.solve_many(PROBLEMS / f"{name}.py", {"duration": [1.0]}, executor=executor, on_device=True)


def test_most_cases_are_solved_on_the_device(simulated):
    on_device = [is_found for name in KINDS for is_found in simulated[name][4]]
    assert sum(on_device) >= 0.7 * len(on_device)


def test_a_sweep_has_the_same_data_set(simulated):
    one, other, difference, on_device = simulated["sweep"]
    assert one == other == [["solved"] * 2, ["solved"] * 2, ["unusable"] * 2, ["solved"] * 2]
    assert difference <= 1e-9
    assert on_device >= 6


def test_a_sweep_of_motions_has_the_bits_of_the_processor(simulated):
    assert simulated["sweep of motions"] == []


def test_too_little_memory_is_told_in_one_line(simulated):
    needed = r"2 cases at once need 0\.\d+ MB, 0\.02 MB are free"
    told = f"the memory of the GPU does not suffice: {needed}; solve with fewer steps"
    assert re.fullmatch(told, simulated["full"])


@pytest.mark.parametrize(
    ("kind", "error", "text"),
    [
        ("full", "DeviceError", "the GPU reports an error: .*OUT_OF_MEMORY.*, 2 of 5 cases are in OUT; .*--resume"),
        ("interrupted", "Interrupted", "interrupted; 2 of 5 cases are in OUT; --resume does the rest"),
    ],
)
def test_a_sweep_that_ends_on_the_device_loses_nothing_and_goes_on(simulated, kind, error, text):
    raised, message, difference, statuses, on_device = simulated[f"{kind} sweep"]
    assert raised == error
    assert re.fullmatch(f"{text}.*", message)
    assert difference <= 1e-9
    assert statuses == ["solved"] * 5
    assert on_device == 4  # a first case, and those that were not stored


def test_workers_are_refused_beside_a_gpu(simulated, monkeypatch):
    from codegen.runtime.cuda import memory

    monkeypatch.setattr(memory, "require_device", lambda: None)
    with pytest.raises(ArgumentError, match="--executor cuda with --workers or --cluster"):
        codegen.sweep(PROBLEMS / "orbital_transfer.py", {"r1": [6.0]}, executor="cuda", workers=2)


def test_motions_with_events_are_refused_in_one_line(monkeypatch):
    from codegen.runtime.cuda import memory

    monkeypatch.setattr(memory, "require_device", lambda: None)
    with pytest.raises(DeviceError, match='the motions of resting_ball have events; use executor "threads"'):
        codegen.sweep(PROBLEMS / "resting_ball.py", {"g": [9.0]}, executor="cuda")
    with pytest.raises(DeviceError, match="have events"):
        codegen.solve_many(PROBLEMS / "resting_ball.py", {"g": [9.0]}, executor="cuda")


def test_a_driver_that_is_too_old_is_one_line(monkeypatch):
    from numba.cuda.cudadrv.error import CudaSupportError

    from codegen.runtime.cuda import memory

    reason = "Call to cuInit results in CUDA_ERROR_SYSTEM_DRIVER_MISMATCH (803)"

    def fail():
        raise CudaSupportError(
            "Error at driver init: \nCall to cuInit results in CUDA_ERROR_SYSTEM_DRIVER_MISMATCH (803)"
        )

    monkeypatch.setattr(memory.cuda, "current_context", fail)
    told = re.escape(f"numba finds no GPU that it can use: {reason}")
    with pytest.raises(DeviceError, match=told) as raised:
        codegen.solve_many(PROBLEMS / "orbital_transfer.py", {"r1": [6.0]}, executor="cuda")
    assert "\n" not in str(raised.value)


def test_without_a_gpu_there_is_one_line(monkeypatch):
    from codegen.runtime.cuda import memory

    def fail():
        raise memory.NoDevice("CUDA driver library cannot be found.")

    monkeypatch.setattr(memory, "require_device", fail)
    with pytest.raises(DeviceError, match=r"numba finds no GPU that it can use: CUDA driver library cannot be found"):
        codegen.solve_many(PROBLEMS / "orbital_transfer.py", {"r1": [6.0]}, executor="cuda")
    with pytest.raises(ArgumentError, match="use one of threads, cuda"):
        codegen.solve_many(PROBLEMS / "orbital_transfer.py", {"r1": [6.0]}, executor="gpu")
