"""Every command in a terminal, with an empty cache and again: progress is shown, stdout stays clean, nothing breaks.

Elsewhere commands run with pipes, where progress is not shown.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import time

import numpy as np
import pytest
from command_lines import PENDULUM
from conftest import PROBLEMS
from terminals import Terminal, on_terminal

from codegen.cli import COMMANDS
from codegen.registration.formats import write_landmarks
from codegen.registration.images import write_image
from codegen.registration.pairs import LandmarkPairs
from codegen.solving.drivers import DRIVERS

CONTROL = '''"""Push a mass from one place to another, with the least effort."""

from codegen import Control, control, coordinate


def problem(limit: float = 0.0) -> Control:
    q, dq = coordinate("q")
    f = control("f")
    return Control(
        lagrangian=dq**2 / 2, force={q: f}, cost=f**2, duration=1, start={q: 0, dq: 0}, end={q: 1, dq: 0},
        bounds={f: (-limit, limit)} if limit else {},
    )
'''
SPRINGS = '''"""Let two masses on a spring vibrate."""

from codegen import Pairwise, Simulate, particles


def problem() -> Simulate:
    i, j = particles("x", "px")
    spring = Pairwise((i, j), self_term=i.p[0] ** 2 / 2, pair_term=(i.q[0] - j.q[0]) ** 2 / 2)
    return Simulate(hamiltonian=spring, start={i.q[0]: [0.0, 1.5], i.p[0]: [0.0, 0.0]}, duration=1)
'''
DROP = '''"""Drop a mass."""

from codegen import Simulate, coordinate


def problem() -> Simulate:
    x, dx = coordinate("x")
    return Simulate(lagrangian=dx**2 / 2 - x, duration=1, start={x: 0, dx: 1}, steps=5)
'''
"""For commands that solve a problem by many schemes on many grids."""
POINTS = "x0,y0,x1,y1\n0.1,0.2,0.22,0.15\n-0.4,0.1,-0.37,0.2\n0.3,-0.5,0.22,-0.46\n"
FEW = ("--set", "kernel=gauss", "--set", "landmarks=points.csv")
KINDS = {
    "simulate": (PENDULUM,),
    "particles": ("springs.py",),
    "control": ("push.py",),
    "bounds": ("push.py", "--set", "limit=5"),
    "connect": (PROBLEMS / "image_registration.py", *FEW),
}
"""A small problem of each task, of which particles and bounds have modules of another kind."""
OF_PROBLEMS = {
    "build": ((), "Deriving"),
    "solve": (("--steps", "4", "--json"), "Solving"),
    "sweep": (("--vary", "steps=4,5", "--workers", "1", "--json"), "0 failed"),
    "check": ((), "Checking"),
    "show": ((), "Deriving"),
    "analyse": ((), "Expanding"),
}
"""Commands that take a problem: what else they are given here, and what a terminal shows."""
UNCACHED = {"show", "analyse", "stress"}
"""Commands that keep nothing for the next time."""
TRIED = [
    *((command, kind) for command in OF_PROBLEMS for kind in ("simulate", "control")),
    *(("solve", kind) for kind in ("particles", "bounds", "connect")),
    ("sweep", "connect"),
    ("analyse", "particles"),
]
"""Every command with both common tasks, and every kind with `solve`, which shows iterates; the others print alike."""
REFUSED = {("analyse", "particles")}
"""Modified equations are not derived for pairs."""
OTHERS = {
    "new": ("pendulum",),
    "report": ("drop.py", "--quick", "--limit", "0.1", "--out", "report"),
    "stress": ("drop.py", "--out", "stress"),
    "warp": ("image.png", "--landmarks", "image.csv", "--out", "warped.png", "--json"),
    "distances": ("specimens.csv", "--out", "distances.csv", "--workers", "1", "--json"),
    "app": ("--no-browser", "--port"),
}
"""The other commands, with small work."""


@pytest.fixture
def folder(tmp_path):
    """A folder with all files that the commands here read."""
    (tmp_path / "push.py").write_text(CONTROL)
    (tmp_path / "springs.py").write_text(SPRINGS)
    (tmp_path / "drop.py").write_text(DROP)
    (tmp_path / "points.csv").write_text(POINTS)
    corners = np.array([[1.0, 1.0], [6.0, 1.0], [1.0, 5.0], [6.0, 5.0]])
    moved = [corners, corners + 0.2 * np.eye(4, 2), corners - 0.3 * np.eye(4, 2)]
    write_image(tmp_path / "image.png", (250.0 * np.random.default_rng(0).random((7, 8))).astype("u1"))
    write_landmarks(tmp_path / "image.csv", pairs=LandmarkPairs(corners, moved[1]))
    rows = [f"{name},{x},{y}" for name, points in zip("abc", moved, strict=True) for x, y in points]
    (tmp_path / "specimens.csv").write_text("\n".join(["specimen,x,y", *rows, ""]))
    return tmp_path


def assert_sound(done, words, status=0):
    """The exit status that is meant, one JSON object on stdout where it was asked for, and no defect."""
    for text in (done.screen, done.stdout):
        assert "Traceback" not in text
        assert "unexpected" not in text
    assert done.status == status, done.screen[-1000:]
    if status:
        assert done.stdout == ""
        assert "codegen: error: " in done.screen
    elif "--json" in words:
        assert isinstance(json.loads(done.stdout), dict)
    assert "\x1b" not in done.stdout


def test_every_command_is_tried():
    """Each stands in a table, and each of `OTHERS` is started by a test of its own kind below."""
    assert {*OF_PROBLEMS, *OTHERS} == set(COMMANDS)
    assert set(OTHERS) == {"new", "report", "stress", "warp", "distances", "app"}


def test_a_problem_is_copied(folder):
    done = on_terminal("new", *OTHERS["new"], folder=folder)
    assert_sound(done, OTHERS["new"])
    assert (folder / "pendulum.py").read_bytes() == (PROBLEMS / "pendulum.py").read_bytes()


@pytest.mark.parametrize(("command", "kind"), TRIED)
def test_commands_about_problems(folder, command, kind):
    words, shown = OF_PROBLEMS[command]
    for run in ("cold", "warm")[: 1 if command in UNCACHED else 2]:
        out = ("--out", f"{run}.nc") if command == "sweep" else ()
        done = on_terminal(command, *KINDS[kind], *words, *out, folder=folder)
        assert_sound(done, words, 2 if (command, kind) in REFUSED else 0)
        assert shown in done.screen


@pytest.mark.parametrize("command", ["report", "stress"])
def test_commands_that_measure(folder, command):
    for _ in ("cold", "warm")[: 1 if command in UNCACHED else 2]:
        done = on_terminal(command, *OTHERS[command], folder=folder)
        assert_sound(done, OTHERS[command])
        assert "\x1b[2K" in done.screen  # a line of progress, which is taken away


@pytest.mark.parametrize(("command", "shown"), [("warp", "Registering"), ("distances", "0 failed")])
def test_commands_that_register(folder, command, shown, solver, cache_folder):
    """With the machine code that this test run has made already, without which they take minutes."""
    done = on_terminal(command, *OTHERS[command], folder=folder, cache=cache_folder, compiled=True)
    assert_sound(done, OTHERS[command])
    assert shown in done.screen


def wait_until_connected(port, patience=60.0):
    end = time.monotonic() + patience
    while True:
        try:
            return socket.create_connection(("localhost", port), 5.0).close()
        except ConnectionRefusedError:
            assert time.monotonic() < end
            time.sleep(0.1)


def test_the_page_is_served_until_it_is_interrupted(folder):
    with socket.create_server(("localhost", 0)) as free:
        port = free.getsockname()[1]
    with Terminal("app", *OTHERS["app"], port, folder=folder, everything=True) as running:
        running.wait_for(f"http://localhost:{port}")
        wait_until_connected(port)
        running.process.send_signal(signal.SIGINT)
    assert running.done.status in (0, 130)
    assert "Traceback" not in running.done.screen
    assert "unexpected" not in running.done.screen


@pytest.mark.parametrize("kind", KINDS)
def test_a_solution_on_the_terminal_itself(folder, kind):
    done = on_terminal("solve", *KINDS[kind], "--steps", "4", folder=folder, everything=True)
    assert_sound(done, ())
    assert "Solving" in done.screen
    assert "status" in done.screen
    assert "solved" in done.screen


OF_DRIVERS = [
    (driver.name, kind)
    for driver in DRIVERS.values()
    for kind in KINDS
    if not driver.generated and ({"particles": "simulate", "bounds": "control"}.get(kind, kind) in driver.tasks)
]
REFUSALS = {("fsolve", "particles"), ("fsolve", "bounds")}
"""What they do not take: steps of particles, inequalities."""


@pytest.mark.parametrize(("driver", "kind"), OF_DRIVERS)
def test_every_driver(folder, driver, kind):
    if driver == "ipopt":
        pytest.importorskip("cyipopt")
    action = ("--method", "action") if kind == "connect" and driver in ("slsqp", "trust-constr") else ()
    words = ("--driver", driver, "--steps", "4", "--json", *action)
    done = on_terminal("solve", *KINDS[kind], *words, folder=folder)
    assert_sound(done, words, 2 if (driver, kind) in REFUSALS else 0)
    assert "Solving" in done.screen


def test_compiled_cold_and_warm(folder):
    """With machine code, which elsewhere here is left out: compiled once, and read by the second process."""
    for shown, build in (("Compiling", 1.0), ("Solving", 0.0)):
        done = on_terminal("solve", PENDULUM, "--json", folder=folder, compiled=True)
        assert_sound(done, ("--json",))
        assert shown in done.screen
        assert json.loads(done.stdout)["seconds"]["build"] > build


def test_nothing_is_shown_where_there_is_no_terminal(folder):
    environment = {**os.environ, "CODEGEN_CACHE_DIR": str(folder / "cache"), "NUMBA_DISABLE_JIT": "1"}
    words = ["python", "-m", "codegen", "solve", "push.py", "--steps", "4", "--json"]
    done = subprocess.run(words, capture_output=True, text=True, cwd=folder, env=environment)
    assert done.returncode == 0
    notes = json.loads(done.stdout)["notes"]
    assert done.stderr.splitlines() == [f"codegen: note: {note}" for note in notes]
    assert json.loads(done.stdout)["status"] == "solved"
