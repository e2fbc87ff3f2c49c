"""Reports of problems: orders, comparisons, resumption, the page; small problems run by the interpreter."""

from __future__ import annotations

import json
from concurrent.futures import Future
from contextlib import contextmanager
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from interpreted import without_compilation
from made_records import control_record

from codegen.cli import main
from codegen.errors import ArgumentError
from codegen.evidence.report import building, gallery, optima, simulations, thesis
from codegen.evidence.report.building import Variant, Workshop
from codegen.evidence.report.comparison import is_exhausted, measured_order, verdict
from codegen.evidence.report.gallery import regressions
from codegen.evidence.report.simulations import conserved, reference_motion
from codegen.evidence.report.store import Case, Extent, Store
from codegen.solving import api
from codegen.solving.machine_code import compilation

OSCILLATOR = '''"""Let a unit mass swing on a spring."""

from codegen import Simulate, canonical_pair


def problem() -> Simulate:
    q, p = canonical_pair("q", "p")
    return Simulate(hamiltonian=p**2 / 2 + q**2 / 2, duration=8, start={q: 1, p: 0}, steps=40)
'''
ROTATION = '''"""Let three states rotate and decay, a first-order system without momenta."""

from codegen import Simulate, states


def problem() -> Simulate:
    x, y, z = states("x y z")
    return Simulate(dynamics={x: y, y: -x, z: -z}, duration=8, start={x: 1, y: 0, z: 100}, steps=40)
'''
EFFORT = '''"""Move a unit mass by one unit of length in one unit of time, with least effort."""

from codegen import Control, control, coordinate


def problem() -> Control:
    x, v = coordinate("x")
    u = control("u")
    return Control(
        lagrangian=v**2 / 2, force={x: u}, cost=u**2, duration=1, start={x: 0, v: 0}, end={x: 1, v: 0}, steps=20
    )
'''
KEPLER = '''"""Let a planet orbit in polar coordinates."""

from codegen import Simulate, coordinates


def problem() -> Simulate:
    (r, phi), (dr, dphi) = coordinates("r phi")
    return Simulate(
        lagrangian=(dr**2 + r**2 * dphi**2) / 2 + 1 / r, duration=1, start={r: 1, phi: 0, dr: 0.1, dphi: 1.1}, steps=10
    )
'''
SPRINGS = '''"""Let three unit masses on a line swing on springs between each two of them."""

from codegen import Pairwise, Simulate, particles


def problem() -> Simulate:
    i, j = particles("x", "p")
    (x, p), (y, _) = (*i.q, *i.p), (*j.q, *j.p)
    pairs = Pairwise((i, j), self_term=p**2 / 2, pair_term=(x - y) ** 2 / 2)
    return Simulate(hamiltonian=pairs, start={x: [-1, 0, 1], p: [0, 0, 0]}, duration=3, steps=30)
'''
TINY = Extent(
    quick=True, simulation_doublings=4, control_doublings=3, reference_seconds=2.0, most_schemes=2, most_simulated=3,
    limit=9.0, time_budget=0.01, drift_steps=2000, sequence_seconds=1.0, peers=False, driver_unknowns=200,
)  # fmt: skip


class Inline:
    """An executor without processes."""

    def submit(self, function, *arguments):
        future = Future()
        future.set_result(function(*arguments))
        return future


@pytest.fixture
def inline(monkeypatch):
    """Builds without worker processes, and modules that are not compiled."""
    loaded = {}

    def load(path):
        if path not in loaded:
            loaded[path] = without_compilation(path.read_text(), path.stem)
        return loaded[path]

    @contextmanager
    def workers():
        yield Inline()

    monkeypatch.setattr("codegen.solving.loading.load", load)
    monkeypatch.setattr(compilation, "parts_of", lambda module: [])  # nor are linear systems
    monkeypatch.setattr(gallery, "workers", workers)


def written(folder: Path, **texts: str) -> list[Path]:
    paths = []
    for name, text in texts.items():
        paths.append(folder / f"{name}.py")
        paths[-1].write_text(text)
    return paths


@pytest.mark.parametrize("order", [1, 2, 4, 6, 8])
def test_orders_are_measured_above_the_plateau(order):
    """Errors 3 N^-a that end in rounding of 1e-13 with signs that vary, as they do."""
    steps = [20 * 2**k for k in range(10)]
    rounding = [1e-13 * (1.0 + 0.5 * np.sin(7.0 * n)) for n in steps]
    errors = [3.0 * (n / 10) ** -order + r for n, r in zip(steps, rounding, strict=True)]
    found = measured_order(steps, errors)
    assert found is not None
    assert found.value == pytest.approx(order, abs=0.05)
    assert is_exhausted(steps, errors) == (order > 4)


def test_an_order_wants_three_points():
    assert measured_order([10, 20], [1e-2, 1e-3]) is None
    assert measured_order([10, 20, 40], [1e-2, None, 1e-3]) is None
    assert measured_order([10, 20, 40, 80], [1e-2, 1e-4, 1e-6, 1e-8], floor=1e-7) is None  # the reference ends it
    found = measured_order([10, 20, 40], [1e-2, 2.5e-3, 6.25e-4])
    assert found is not None
    assert (found.value, found.coarsest, found.finest) == (pytest.approx(2.0), 10, 40)
    assert measured_order([10, 20, 40, 80, 160], [1.4, 1.2, 0.9, 0.7, 0.6]) is None  # nothing like the exact motion


THIRDS = [round(24 * 2 ** (k / 3)) for k in range(20)]
"""Numbers of steps that grow by a third of a doubling, as far as integers allow."""


def test_an_order_is_that_of_the_asymptotic_range():
    """Where a term that vanishes faster prevails on coarse grids, these do not count: 1e3 N^-4 + N^-2 is of order 2."""
    found = measured_order(THIRDS, [1e3 * n**-4.0 + n**-2.0 for n in THIRDS])
    assert found is not None
    assert found.value == pytest.approx(2.0, abs=0.02)
    assert found.coarsest > 300
    assert verdict(found, 2) == ""


def test_no_order_is_reported_before_the_asymptotic_range():
    """The same, ended by rounding before the slower term shows; and errors that swing."""
    coarse = THIRDS[:9]
    assert measured_order(coarse, [1e6 * n**-6.0 + n**-2.0 for n in coarse]) is None
    swinging = [n**-2.0 * (2.0 + np.sin(3.0 * np.log(n))) for n in THIRDS]
    assert measured_order(THIRDS, swinging) is None
    assert verdict(None, 2) == "not asymptotic"


@pytest.mark.parametrize(
    ("order", "expected", "said"),
    [
        (2.05, 2, ""),
        (3.0, 2, "superconvergent"),
        (1.8, 2, "below the expected order"),
        (5.75, 6, ""),
        (8.35, 8, "superconvergent"),
        (3.85, 4, "below the expected order"),
    ],
)
def test_verdicts_on_orders(order, expected, said):
    found = measured_order(THIRDS, [10.0 * n**-order for n in THIRDS])
    assert verdict(found, expected) == said


GOOD = {"problem": "p", "case": "c", "status": "solved", "error": 1e-4, "seconds": 0.01, "order": 2.0}


@pytest.mark.parametrize(
    ("change", "what"),
    [
        ({}, None),
        ({"error": 1.9e-4, "seconds": 0.019, "order": 1.8}, None),
        ({"error": 2.1e-4}, "error"),
        ({"seconds": 0.021}, "seconds"),
        ({"order": 1.6}, "order"),
        ({"order": None}, "order"),
        ({"status": "stalled", "error": None}, "status"),
        ({"case": "new", "status": "stalled"}, None),
        ({"error": 1e-9, "seconds": 1e-4}, None),
    ],
)
def test_comparison_marks_what_is_worse(change, what):
    found = regressions([GOOD], [GOOD | change])
    assert [r.what for r in found] == ([] if what is None else [what])


def test_rounding_and_clocks_are_no_regressions():
    small = GOOD | {"error": 1e-15, "seconds": 1e-5}
    assert regressions([small], [small | {"error": 9e-12, "seconds": 1.9e-3}]) == []


def test_the_reference_motion_is_the_closed_form(tmp_path, inline):
    (oscillator,) = written(tmp_path, oscillator=OSCILLATOR)
    workshop = Workshop(tmp_path / "modules", Store(tmp_path / "store.jsonl"))
    module = workshop.module(Variant(oscillator, "hamiltonian", "explicit-euler", 1))
    motion = reference_motion(module, 4)
    exact = np.column_stack([np.cos(motion.times), -np.sin(motion.times)])
    np.testing.assert_allclose(motion.states, exact, atol=1e-12)
    assert conserved(module) == {}


def test_first_order_dynamics_have_sizes_of_their_own_and_no_energy(tmp_path, inline):
    (rotation,) = written(tmp_path, rotation=ROTATION)
    workshop = Workshop(tmp_path / "modules", Store(tmp_path / "store.jsonl"))
    module = workshop.module(Variant(rotation, "one-step", "explicit-euler", 1))
    motion = reference_motion(module, 4)
    t = motion.times
    np.testing.assert_allclose(motion.states, np.column_stack([np.cos(t), -np.sin(t), 100 * np.exp(-t)]), atol=1e-10)
    sizes = simulations.component_sizes(module, motion.states)
    np.testing.assert_allclose(sizes, np.abs(motion.states).max(axis=0))
    assert conserved(module) == {}


def test_cyclic_coordinates_are_found(tmp_path, inline):
    """Noether's theorem: the angle of a planet is cyclic, its distance is not."""
    (kepler,) = written(tmp_path, kepler=KEPLER)
    workshop = Workshop(tmp_path / "modules", Store(tmp_path / "store.jsonl"))
    found = conserved(workshop.module(Variant(kepler, "hamiltonian", "explicit-euler", 1)))
    assert len(found) == 1
    (momentum,) = found.values()
    np.testing.assert_array_equal(momentum(np.array([[1.0, 2.0, 3.0, 4.0], [5.0, 6.0, 7.0, 8.0]])), [4.0, 8.0])


class Balance(HTMLParser):
    """Elements that are open, and references to anything outside of the page."""

    def __init__(self) -> None:
        super().__init__()
        self.opened: list[str] = []
        self.outside: list[str] = []

    def handle_starttag(self, tag, attrs):
        if tag not in ("meta", "br"):
            self.opened.append(tag)
        self.handle_startendtag(tag, attrs)

    def handle_startendtag(self, tag, attrs):
        self.outside += [v for k, v in attrs if k in ("src", "href", "xlink:href") and not v.startswith("#")]

    def handle_endtag(self, tag):
        assert self.opened.pop() == tag


def test_two_problems_from_end_to_end(tmp_path, inline, monkeypatch):
    """A page, orders as stated, a cost error against 12, nothing measured twice, and a comparison."""
    problems = written(tmp_path, effort=EFFORT, oscillator=OSCILLATOR)
    out = tmp_path / "out"
    made = gallery.run(problems, out, TINY)
    text = made.page.read_text()
    balance = Balance()
    balance.feed(text)
    assert balance.opened == []
    assert balance.outside == []
    assert "<script" not in text
    assert len(text.encode()) < 15e6
    assert "All problems at a glance" in text
    assert "Fastest to an error of states, controls and cost" in text
    assert "Fastest to an error of trajectory" in text
    store = Store(out / "quick.jsonl")
    orders = {
        ("oscillator", v.scheme): (v.order, simulations.measured(store, problems[1], v).order)
        for v in gallery.choose(problems[1], store, TINY).variants
    }
    assert len(orders) == 3
    for stated, order in orders.values():
        assert order is not None
        assert abs(order.value - stated) < (0.1 if stated < 6 else 0.3)
    control = gallery.choose(problems[0], store, TINY)
    assert control.omitted
    for variant in control.variants:  # where controls are constant on intervals, order 2 is all there is
        highest = 2 if variant.controls == "interval" else variant.order
        assert optima.measured(store, problems[0], variant).expected == min(variant.order, highest)
    assert store.get(building.SURVEYS, "effort")["exact cost"] == pytest.approx(12.0, rel=1e-15)
    measured = optima.measured(store, problems[0], control.variants[0])
    for values, error in zip(measured.rows, measured.errors, strict=True):
        assert error == pytest.approx(
            1.0 / (values["steps"] ** 2 - 1), rel=1e-6
        )  # 12 N^2/(N^2 - 1) is the discrete cost
    for name in ("effort", "oscillator"):  # with nothing left out there is more of everything, and the same answer
        runs = dict(store.rows(f"{name}: general form"))
        assert runs
        for label, run in runs.items():
            assert run["general status"] == "solved"
            assert run["difference"] < 1e-9
            lines = [store.get(building.MODULES, f"{name}; {form}")["lines"] for form in (label.split(",")[0], label)]
            assert lines[0] < lines[1]
        assert f"{name}: parts that its modules do not need" in text
    assert {name for name, _ in store.rows("effort: drivers")} == {"newton", "slsqp", "trust-constr", "fsolve"}

    def refuse(*_arguments, **_options):
        raise AssertionError("measured twice")

    before = (out / "quick.jsonl").read_bytes()
    monkeypatch.setattr(api, "solve", refuse)
    again = gallery.run(problems, out, TINY, earlier=out)
    assert again.regressions == ()
    assert "nothing is worse" in again.page.read_text()
    assert (out / "quick.jsonl").read_bytes() == before

    better = json.loads((out / gallery.NAME).read_text())
    for case in better["cases"]:
        if case.get("error"):
            case["error"] /= 3.0
    (tmp_path / "better.json").write_text(json.dumps(better))
    worse = gallery.run(problems, out, TINY, earlier=tmp_path / "better.json")
    assert {r.what for r in worse.regressions} == {"error"}
    assert "regressions" in worse.page.read_text()


def test_what_is_killed_while_writing_is_measured_again(tmp_path):
    path, calls = tmp_path / "store.jsonl", []
    case = Case("s", "a", lambda: {"n": len(calls), **(calls.append(1) or {})})
    assert Store(path).measured(case)
    assert not Store(path).measured(case)
    path.write_text(path.read_text()[:-5])
    assert Store(path).measured(case)
    assert len(calls) == 2


def test_a_report_on_particles(tmp_path, inline):
    """Outer masses are x = -+cos(sqrt(3) t): the schemes have their orders."""
    (springs,) = written(tmp_path, springs=SPRINGS)
    gallery.run([springs], tmp_path / "out", TINY)
    store = Store(tmp_path / "out" / "quick.jsonl")
    (reference,) = [values for _, values in store.rows("springs: reference")]
    states = np.array(reference["states"])
    np.testing.assert_allclose(states[:, 0], -np.cos(np.sqrt(3.0) * np.array(reference["times"])), atol=1e-9)
    for variant in gallery.choose(springs, store, TINY).variants:
        order = simulations.measured(store, springs, variant).order
        assert abs(order.value - variant.order) < (0.1 if variant.order < 6 else 0.3)


def test_a_problem_that_cannot_be_read_is_said_on_the_page(tmp_path, inline):
    problems = written(tmp_path, broken="'''Nothing.'''\n", other="'''Nothing either.'''\n")
    text = gallery.run(problems, tmp_path / "out", TINY).page.read_text()
    assert text.count("not measured here") >= 2


def test_comparison_wants_a_report(tmp_path):
    with pytest.raises(ArgumentError, match="no report is there"):
        gallery.read_record(tmp_path)


@pytest.mark.parametrize("words", [[], ["absent.py"], ["absent", "--all"]])
def test_the_command_refuses_in_one_line(tmp_path, capsys, words):
    with pytest.raises(SystemExit) as ended:
        main(["report", *words, "--out", str(tmp_path / "out")])
    assert ended.value.code == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
    assert not (tmp_path / "out").exists()


def test_reports_of_different_problems_are_not_compared():
    one, other = (gallery.Record({}, ({"problem": name, "case": "c"},)) for name in "ab")
    with pytest.raises(ArgumentError, match="no case in common"):
        gallery.compared(one, other)


def test_a_satellite_without_thrust_comes_back():
    """The equations of R-K, written by hand, on a circular orbit with Kepler's period; thrust leads astray."""
    gravity, radius = 0.4, 5.0
    module = SimpleNamespace(
        metadata=control_record(parameters={"m": 100.0, "GM": gravity, "r0": radius, "r1": radius})
    )
    times = np.linspace(0.0, 4.0 * np.pi * np.sqrt(radius**3 / gravity), 21)
    idle = SimpleNamespace(t=times, u=np.zeros((20, 1)))
    found = thesis._reintegrated(module, idle, 2)
    assert found["miss"] < 1e-7
    assert found["velocity miss"] < 1e-8
    assert thesis._reintegrated(module, SimpleNamespace(t=times, u=np.full((20, 1), 0.01)), 2)["miss"] > 0.1


BOUNCING = '''"""Drop a ball on a floor."""
from codegen import Simulate, coordinate

def problem():
    y, v = coordinate("y")
    return Simulate(
        lagrangian=v**2 / 2 - 8 * y, unilateral={"floor": y >= 0}, restitution=0.5,
        start={y: 1, v: 0}, duration=0.8, steps=40,
    )
'''


def test_a_motion_with_impacts_is_compared_with_the_finest_grid_of_a_scheme(tmp_path, inline):
    """The ball falls during 1/2 and has the velocity 2 after the impact: y = 2 s - 4 s^2 at s = t - 1/2."""
    (ball,) = written(tmp_path, ball=BOUNCING)
    made = gallery.run([ball], tmp_path / "out", TINY)
    store = Store(tmp_path / "out" / "quick.jsonl")
    reference = store.get("ball: reference", "motion")
    assert reference["states"][-1] == pytest.approx([2 * 0.3 - 4 * 0.09, 2 - 8 * 0.3], abs=1e-12)
    assert reference["error"] < 1e-11
    rows = dict(store.rows("ball: errors"))
    assert len(rows) >= 3
    assert min(row["trajectory"] for row in rows.values()) < 1e-12
    assert "half as many steps differs from it by" in made.page.read_text()
