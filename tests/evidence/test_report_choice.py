"""Times by a made clock, the choice of the fastest scheme, labels of curves, and references of optima."""

from __future__ import annotations

import importlib
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from interpreted import without_compilation
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.text import Text

from codegen.emit.naming import Choices
from codegen.evidence.report import building, comparison, peers
from codegen.evidence.report.comparison import Ladder, choice, figures, ranking
from codegen.evidence.report.optima import ALL, elsewhere, ladder_of, solved
from codegen.evidence.report.reference import Trajectory, read_trajectory, refined, trajectory_of
from codegen.evidence.report.store import Store
from codegen.solving import api
from codegen.solving.compiler import generate

EFFORT = '''"""Move a unit mass by one unit of length in one unit of time, with least effort."""

from codegen import Control, control, coordinate


def problem() -> Control:
    x, v = coordinate("x")
    u = control("u")
    return Control(
        lagrangian=v**2 / 2, force={x: u}, cost=u**2, duration=1, start={x: 0, v: 0}, end={x: 1, v: 0}, steps=20
    )
'''


@pytest.fixture
def clock(monkeypatch):
    """A clock that only runs of the test advance: `busy` seconds of the thread, and `idle` seconds of the wall."""
    state = SimpleNamespace(busy=0.0, wall=0.0)
    monkeypatch.setattr(
        building,
        "time",
        SimpleNamespace(perf_counter=lambda: state.wall, thread_time_ns=lambda: round(1e9 * state.busy)),
    )
    return state


def runs_of(state, seconds, idle=0.0):
    """A function whose calls take the given processor seconds in turn."""
    count = 0

    def run():
        nonlocal count
        state.busy += seconds[count % len(seconds)]
        state.wall += seconds[count % len(seconds)] + idle
        count += 1

    return run


@pytest.mark.fast
def test_the_time_of_a_solve_excludes_the_time_of_others(clock):
    """A solve of 10 us is repeated within a sample, and 90 us of other programs are in the wall clock alone."""
    measured = building.timed(runs_of(clock, [1e-5], idle=9e-5), 1.0)
    assert measured.processor == pytest.approx(1e-5, rel=1e-3)
    assert measured.wall == pytest.approx(1e-4, rel=1e-3)
    assert measured.samples == building.LEAST_SAMPLES
    assert measured.spread < 1e-3


@pytest.mark.fast
def test_samples_go_on_until_their_spread_is_known(clock, tmp_path):
    """Rounds take a steady and an unsteady solve in turns, then the unsteady solve alone; the median is robust."""
    problem, store = Path("p.py"), Store(tmp_path / "s.jsonl")
    unsteady = [2e-3, 3e-3, 2e-3]
    runs = {"steady": runs_of(clock, [5e-3]), "unsteady": runs_of(clock, unsteady)}
    for case in building.cases(problem, runs, store, 100.0):
        assert store.measured(case)
    assert list(building.cases(problem, runs, store, 100.0)) == []
    measured = building.times(store, problem)
    assert measured["steady"].samples == building.LEAST_SAMPLES
    assert measured["steady"].processor == pytest.approx(5e-3)
    assert measured["unsteady"].samples == building.MOST_SAMPLES
    assert measured["unsteady"].processor == pytest.approx(2e-3)
    assert building.timed(runs_of(clock, [0.5, 0.9]), 1.0).samples <= 2  # the budget ends them


STEPS = [10 * 2**k for k in range(10)]


def ladder(label, order, seconds_of_a_step):
    errors = [float(n) ** -order for n in STEPS]
    return Ladder(label, order, STEPS, [seconds_of_a_step * n for n in STEPS], {"states": errors})


@pytest.mark.fast
def test_the_fastest_scheme_is_the_one_of_two_power_laws():
    """Errors N^-2 at 1 us a step and N^-4 at 5 us: 1e-6 takes 1 ms and 158 us. 10 steps, the fewest, take 50 us."""
    low, high = ladder("variational low", 2, 1e-6), ladder("variational high", 4, 5e-6)
    assert low.reach("states", 1e-6) == (pytest.approx(1e-3), pytest.approx(1000.0))
    assert low.reach("states", 1e-9) is None  # the finest grid has 4e-8
    assert [row[0] for row in ranking([low, high], "states", 1e-6)] == [high, low]
    sentences, table = choice([low, high], {"states": 1e-9})
    (sentence,) = sentences
    assert "10⁻³: variational low" in sentence
    assert "10⁻⁶: variational high" in sentence
    first, second, third = ([cell.replace("\N{NO-BREAK SPACE}", " ") for cell in row] for row in table.rows)
    assert first[2:] == ["variational low", "32", "0.0316 ms", "variational high, × 1.6", "0.0316 ms, × 1.0"]
    assert second[2:] == ["variational high", "32", "0.158 ms", "variational low, × 6.3", "1.00 ms, × 6.3"]
    assert third[2] == "the reference is not accurate enough"


@pytest.mark.fast
def test_an_error_that_is_small_by_chance_does_not_count():
    lucky = Ladder("a", 2, [10, 20, 40, 80], [1.0, 2.0, 4.0, 8.0], {"cost": [1e-2, 1e-5, 1e-3, 1e-6]})
    reached = lucky.reach("cost", 1e-4)
    assert reached is not None
    assert 4.0 < reached[0] < 8.0
    failed = Ladder("b", 2, [10, 20, 40], [1.0, None, 4.0], {"cost": [1e-2, None, 1e-6]})
    assert failed.reach("cost", 1e-4) == (pytest.approx(2.0), pytest.approx(20.0))


@pytest.mark.fast
def test_panels_have_few_curves_whose_labels_do_not_overlap():
    """All curves end in one point, the worst case for labels."""
    many = [ladder(f"hamiltonian scheme-{k}", 4, 1e-6) for k in range(20)]
    pictures = figures(many, {"states": 0.0}, "states")
    assert len(pictures) == 3  # 8, then 12 others by 7
    figure = comparison._panels(many[: comparison.MOST_CURVES], {"states": 0.0, "cost": 0.0}, None)
    renderer = FigureCanvasAgg(figure).get_renderer()
    figure.draw(renderer)
    labels = [Text.get_window_extent(text, renderer) for text in figure.axes[0].texts]
    assert len(labels) == comparison.MOST_CURVES
    assert not any(a.overlaps(b) for i, a in enumerate(labels) for b in labels[:i])
    assert max(label.x1 for label in labels) < figure.axes[1].get_window_extent().x0
    assert min(label.x0 for label in labels) > figure.axes[0].get_window_extent().x1


def module_of(folder: Path, scheme: str, method: str, controls: str):
    path = folder / "effort.py"
    path.write_text(EFFORT)
    return without_compilation(generate(path, {}, Choices(scheme, method, controls)))


def exact(nodes, times) -> Trajectory:
    """The optimum: x = 3 t^2 - 2 t^3, p = 6 t - 6 t^2, u = 6 - 12 t."""
    states = np.column_stack([3.0 * nodes**2 - 2.0 * nodes**3, 6.0 * nodes - 6.0 * nodes**2])
    return Trajectory(1.0, nodes, states, times, (6.0 - 12.0 * times)[:, None])


def test_errors_of_states_and_controls_are_those_of_the_discrete_optimum(tmp_path):
    """With N intervals the control is c (1 - 2 t) at midpoints, c = 6 N^2 / (N^2 - 1), which moves the mass by one."""
    module, n = module_of(tmp_path, "midpoint", "variational", "interval"), 8
    reference = exact(np.linspace(0.0, 1.0, 101), np.linspace(0.0, 1.0, 101))
    values = solved(module, n, trajectory=reference)
    times = (np.arange(n) + 0.5) / n
    root_mean_square = np.sqrt(np.mean((1.0 - 2.0 * times) ** 2))
    assert values["controls"] == pytest.approx(root_mean_square / (n**2 - 1), rel=1e-8)
    momenta = np.concatenate([[0.0], np.cumsum(6.0 * n**2 / (n**2 - 1) * (1.0 - 2.0 * times) / n)])
    nodes = np.linspace(0.0, 1.0, n + 1)
    of_momenta = np.abs(momenta - 6.0 * nodes * (1.0 - nodes)).max() / 1.5
    assert values["states"] == pytest.approx(of_momenta, rel=1e-6)


def test_the_reference_is_the_closed_form_within_its_estimate(tmp_path):
    module = module_of(tmp_path, "gauss-4", "variational", "stages")
    values = refined([("gauss-4", module)], 5, 20.0)
    found = read_trajectory({name: np.array(value).tolist() for name, value in values.items() if name != "errors"})
    true = exact(found.nodes, found.times).errors(found)
    for name in ("states", "controls"):
        assert true[name] <= values["errors"][name] + 1e-11
        assert true[name] < 1e-9
    assert values["cost"] == pytest.approx(12.0, rel=1e-10)
    again = trajectory_of(api.solve(module, steps=values["steps"]))
    assert found.errors(again)["states"] < 1e-9


def least_effort(n: int) -> tuple[float, np.ndarray]:
    """The least cost by the trapezoidal rule that moves the mass by the midpoint rule, and the means of its forces."""
    weights, means = np.array([0.5, *[1.0] * (n - 1), 0.5]) / n, 0.5 * (np.eye(n + 1)[1:] + np.eye(n + 1)[:-1])
    speeds = np.tril(np.ones((n, n))) @ means / n  # at the ends of intervals
    ends = np.array([(speeds.sum(axis=0) - 0.5 * speeds[-1]) / n, speeds[-1]])
    multipliers = np.linalg.solve(ends / weights @ ends.T, [1.0, 0.0])
    forces = ends.T @ multipliers / weights
    return float(weights @ forces**2), means @ forces


@pytest.mark.parametrize("peer", peers.PEERS, ids=lambda peer: peer.name)
def test_other_programs_solve_the_problem_as_the_author_wrote_it(tmp_path, peer):
    if find_spec(peer.package) is None or (peer.package == "opty" and find_spec("cyipopt") is None):
        pytest.skip(f"{peer.package} is not installed")  # without an import: that of dymos warns
    if peer.package == "casadi" and not importlib.import_module("casadi").has_nlpsol(peer.solver):
        pytest.skip(f"this CasADi has no {peer.solver}")
    path, n = tmp_path / "effort.py", 8
    path.write_text(EFFORT)
    fine = np.linspace(0.0, 1.0, 101)
    reference = {
        name: getattr(exact(fine, fine), name) for name in ("duration", "nodes", "states", "times", "controls")
    }
    guess = peers.Guess(np.linspace(0.0, 1.0, n + 1)[:, None], np.zeros((n + 1, 1)), np.zeros((n, 1)))
    (row,) = peers.measured(peer, path, [guess], reference, 9.0, 0.01)["rows"]
    assert row["status"] == "solved"
    exact_forces = 6.0 - 12.0 * (np.arange(n) + 0.5) / n
    factor = n**2 / (n**2 - 1.0)  # constant forces on intervals, for which rk4 is exact, are larger
    cost, forces = {
        "casadi": (12.0 * factor, factor * exact_forces), "opty": least_effort(n), "dymos": (12.0, exact_forces),
    }[peer.package]  # fmt: skip
    assert row["cost"] == pytest.approx(cost, rel=1e-8)
    assert row["controls"] == pytest.approx(np.sqrt(np.mean((forces - exact_forces) ** 2)) / 6.0, rel=1e-5, abs=1e-5)
    path.write_text(EFFORT.replace("steps=20", "path={'speed': v <= 9}, steps=20"))
    refused = peers.measured(peer, path, [guess], reference, 9.0, 0.01)
    assert (refused["rows"], refused["message"]) == ([], "no program for problems with path")


@pytest.mark.fast
def test_a_grid_with_another_local_optimum_has_no_error():
    """Coarse grids may be far from the optimum; a fine grid that is far, after a close one, has found another."""
    errors = {6: 0.3, 12: 0.2, 24: 5e-3, 48: 1.2, 96: 1e-6}
    rows = [{"steps": n, "seconds": n * 1e-6, "states": error, "controls": error} for n, error in errors.items()]
    assert elsewhere(rows) == {48}
    found = ladder_of("a", 4, rows, list(errors.values()))
    assert found.errors["states"] == [0.3, 0.2, 5e-3, None, 1e-6]
    assert found.errors[ALL] == found.errors["states"]
    reached = found.reach("states", 1e-3)
    assert reached is not None
    assert 24.0 < reached[1] < 96.0
