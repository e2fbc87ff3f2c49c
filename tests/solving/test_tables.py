"""Problems with tables: of polynomials, which cubic splines reproduce, against the same problems without tables."""

from __future__ import annotations

import hashlib
import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from interpreted import without_compilation

import codegen
from codegen.errors import ArgumentError, TableError
from codegen.solving.compiler import build

IPOPT = pytest.param("ipopt", marks=pytest.mark.skipif(find_spec("cyipopt") is None, reason="cyipopt is an extra"))

_CONTROL = '''"""An oscillator with a spring and with drag, driven to rest in a wind."""

from codegen import Control, Table, control, states, time


def problem() -> Control:
    x, v = states("x v")
    u, t = control("u"), time()
    {tables}
    return Control(
        dynamics={{x: v, v: u - spring(x) - drag(x, v) + wind(t)}},
        cost=u**2 + drag(v, x) / 50,
        duration=3,
        start={{x: 1, v: 0}},
        end={{x: 0, v: 0}},
        steps=30,
    )
'''
_TABLES = """spring = Table("spring.csv", "x", "f", name="spring"{options})
    drag = Table("drag.csv", ("x", "v"), "f", name="drag")
    wind = Table("wind.csv", "t", "f", name="wind")"""
_FORMULAS = """spring = lambda x: x + x**3 / 3 - x**2 / 7
    drag = lambda x, v: v / 5 + v**3 * x**2 / 9 + x**3 / 8
    wind = lambda t: t * (3 - t) / 5"""


def write_tables(folder: Path, stiffness: float = 1.0, ends: tuple[float, float] = (-3.0, 3.0), cells: int = 6) -> None:
    """Tables of the polynomials in _FORMULAS, on breakpoints that are not equidistant."""
    axis = ends[0] + (ends[1] - ends[0]) * (np.arange(cells + 1) / cells) ** 1.2
    spring = stiffness * (axis + axis**3 / 3 - axis**2 / 7)
    x, v = np.meshgrid(np.array([-3.0, -1.0, 0.2, 1.0, 3.1]), np.linspace(-4, 4, 6), indexing="ij")
    times = np.linspace(0, 3, 5)
    curves = (("spring.csv", "x,f", axis, spring), ("wind.csv", "t,f", times, times * (3 - times) / 5))
    for name, head, *columns in curves:
        np.savetxt(folder / name, np.stack(columns, axis=1), delimiter=",", header=head, comments="", fmt="%.17g")
    columns = [x, v, v / 5 + v**3 * x**2 / 9 + x**3 / 8]
    rows = np.stack([c.ravel() for c in columns], axis=1)
    np.savetxt(folder / "drag.csv", rows, delimiter=",", header="x,v,f", comments="", fmt="%.17g")


def write_problem(folder: Path, tables: str = _TABLES, options: str = "", name: str = "tabled") -> Path:
    path = folder / f"{name}.py"
    path.write_text(_CONTROL.format(tables=tables.format(options=options)))
    return path


def interpreted(path: Path, **choices: str):
    return without_compilation(build(path, **choices).path.read_text())


@pytest.fixture
def tabled(folder):
    write_tables(folder)
    return write_problem(folder)


@pytest.mark.parametrize("choices", [{}, {"scheme": "gauss-4", "controls": "stages"}, {"scheme": "rk4"}], ids=str)
def test_tables_of_polynomials_are_those(folder, tabled, choices):
    found = interpreted(tabled, **choices).solve(12)
    exact = interpreted(write_problem(folder, _FORMULAS, name="written"), **choices).solve(12)
    assert found.status == exact.status == "solved"
    assert found.cost == pytest.approx(exact.cost, rel=1e-12)
    assert found.q == pytest.approx(exact.q, abs=1e-11)
    assert found.iterations == exact.iterations


@pytest.mark.parametrize("driver", ["newton", IPOPT, "slsqp", "trust-constr"])
def test_drivers_agree(tabled, driver):
    result = codegen.solve(interpreted(tabled), driver)
    written = codegen.solve(interpreted(write_problem(tabled.parent, _FORMULAS, name="written")))
    assert result.status == written.status == "solved"
    assert result.cost == pytest.approx(written.cost, rel=1e-8)


def test_another_table_needs_no_build(tabled, folder, uncompiled):
    plain = codegen.solve(tabled)
    (folder / "other").mkdir()
    write_tables(folder / "other", stiffness=2.0)
    module = interpreted(tabled)
    replaced = codegen.solve(module, tables={"spring": folder / "other" / "spring.csv"})
    write_tables(folder, stiffness=2.0)
    changed = codegen.solve(interpreted(tabled))
    assert replaced.cost == pytest.approx(changed.cost, rel=1e-12)
    assert abs(replaced.cost - plain.cost) > 0.1
    numbers = interpreted(tabled).TABLES["spring"]
    assert module.solve(tables={"spring": numbers}).cost == pytest.approx(changed.cost, rel=1e-12)
    assert module.solve().cost == pytest.approx(plain.cost, rel=1e-12)
    write_tables(folder / "other", ends=(-0.8, 0.8))
    result = codegen.solve(module, tables={"spring": folder / "other" / "spring.csv"})
    assert result.status == "outside a table"
    assert "on interval 0 (t = 0), outside -0.8 to 0.8" in result.message


def test_what_does_not_replace_a_table_is_refused(tabled, folder):
    module = interpreted(tabled)
    few = folder / "few.csv"
    few.write_text("x,f\n0,0\n1,1\n2,2\n3,3\n")
    for tables, error, fragment in (
        ({"spring": few}, TableError, "4 breakpoints, and the module is built for 7"),
        ({"sprung": few}, ArgumentError, "has no table sprung; name one of drag, spring, wind"),
        ({"wind": few}, TableError, "no column 't'"),
        ({"wind": 3}, ArgumentError, "give names and files"),
    ):
        with pytest.raises(error, match=fragment):
            codegen.solve(module, tables=tables)
    own = module.TABLES["spring"]
    for numbers, fragment in ((own[:-1], "shape"), (own * np.nan, "finite"), (own[::-1].copy(), "ascend")):
        with pytest.raises(ValueError, match=fragment):
            module.make_grid(3, tables={"spring": numbers})
    with pytest.raises(ValueError, match="there is no table 'sprung'"):
        module.make_grid(3, tables={"sprung": own})
    with pytest.raises(ArgumentError, match="the problem has no table spring"):
        codegen.solve(Path(__file__).parents[2] / "problems" / "pendulum.py", tables={"spring": few})


@pytest.mark.parametrize("driver", ["newton", IPOPT])
def test_outside_a_table_nothing_is_solved(folder, tabled, driver):
    write_tables(folder, ends=(-0.8, 0.8))
    result = codegen.solve(interpreted(tabled), driver)
    assert result.status == "outside a table"
    assert "x of table spring is 0.99" in result.message
    assert "on interval 0 (t = 0), outside -0.8 to 0.8" in result.message
    for outside in ("extend", "clamp"):
        path = write_problem(folder, options=f', outside="{outside}"', name=outside)
        assert codegen.solve(interpreted(path), driver).status == "solved"


def test_extended_tables_go_on_as_polynomials(folder, tabled):
    wide = interpreted(tabled).solve(12)
    write_tables(folder, ends=(-0.5, 0.5))
    narrow = interpreted(write_problem(folder, options=', outside="extend"', name="narrow")).solve(12)
    assert narrow.cost == pytest.approx(wide.cost, rel=1e-10)


def test_monotone_and_linear_tables_are_solved(folder, tabled):
    reference = interpreted(tabled).solve(12).cost
    write_tables(folder, cells=60)
    for kind in ("monotone", "linear"):
        found = interpreted(write_problem(folder, options=f', kind="{kind}"', name=kind)).solve(12)
        assert found.status == "solved"
        assert 1e-9 < abs(found.cost - reference) < 0.02 * reference


_PHASES = '''"""A cart that is braked by a table, in two phases of free duration."""

from codegen import Control, Phases, Table, control, free_parameter, states


def problem() -> Phases:
    x, v = states("x v")
    u, T = control("u"), free_parameter("T", 1.0, lower=0.1)
    drag = {drag}
    motion = {{"dynamics": {{x: v, v: u - drag(v)}}, "cost": u**2 + 1, "duration": T, "steps": 10}}
    return Phases(
        Control(**motion, start={{x: 0, v: 0}}, end={{x: 1}}, terminal_cost=drag(v)),
        Control(**motion, end={{x: 2, v: 0}}),
    )
'''


def test_phases_with_tables(folder):
    v = np.linspace(-2, 4, 6)
    np.savetxt(folder / "drag.csv", np.stack([v, v**2 / 5 + v**3 / 50], 1), delimiter=",", header="v,drag", comments="")
    (folder / "tabled.py").write_text(_PHASES.format(drag='Table("drag.csv", "v", "drag")'))
    (folder / "written.py").write_text(_PHASES.format(drag="lambda v: v**2 / 5 + v**3 / 50"))
    found, exact = (interpreted(folder / name).solve() for name in ("tabled.py", "written.py"))
    assert (found.status, exact.status) == ("solved", "solved"), (found.message, exact.message)
    assert found.cost == pytest.approx(exact.cost, rel=1e-10)
    v /= 10
    np.savetxt(folder / "drag.csv", np.stack([v, v**2 / 5 + v**3 / 50], 1), delimiter=",", header="v,drag", comments="")
    assert "v of table drag is" in interpreted(folder / "tabled.py").solve().message


_SIMULATE = '''"""A mass in a potential and a wind from tables."""

from codegen import Simulate, Table, coordinate, time


def problem(duration: float = 3.0) -> Simulate:
    x, v = coordinate("x")
    t = time()
    {tables}
    return Simulate(
        lagrangian=v**2 / 2 - potential(x), force={{x: wind(t)}}, duration=duration, start={{x: 1, v: 0}}, steps=40
    )
'''


@pytest.mark.parametrize("scheme", ["midpoint", "stormer-verlet", "gauss-4", "yoshida-4"])
def test_motions_in_tables(folder, scheme):
    x, t = np.linspace(-2, 2, 9), np.linspace(0, 3, 5)
    for name, head, at, values in (("v", "x,v", x, x**3 / 9 + x**2 / 2), ("w", "t,w", t, t * (3 - t))):
        np.savetxt(folder / f"{name}.csv", np.stack([at, values], 1), delimiter=",", header=head, comments="")
    tables = 'potential, wind = Table("v.csv", "x", "v"), Table("w.csv", "t", "w", outside="error")'
    (folder / "tabled.py").write_text(_SIMULATE.format(tables=tables))
    formulas = "potential, wind = lambda x: x**3 / 9 + x**2 / 2, lambda t: t * (3 - t)"
    (folder / "written.py").write_text(_SIMULATE.format(tables=formulas))
    found, exact = (interpreted(folder / name, scheme=scheme).solve() for name in ("tabled.py", "written.py"))
    assert found.status == exact.status == "solved"
    assert found.q == pytest.approx(exact.q, abs=1e-11)
    assert found.energy == pytest.approx(exact.energy, abs=1e-11)
    longer = interpreted(folder / "tabled.py", scheme=scheme).solve(duration=4.0)
    assert longer.status == "outside a table"
    assert "in step 31 of 40" in longer.message
    assert "t of table w is 3." in longer.message
    assert longer.t[-1] == pytest.approx(3.0)


def test_another_driver_of_a_motion_leaves_no_table(folder):
    x = np.linspace(-2, 2, 9)
    for name, head, at in (("v", "x,v", x), ("w", "t,w", np.linspace(0, 2, 5))):
        np.savetxt(folder / f"{name}.csv", np.stack([at, at**2], 1), delimiter=",", header=head, comments="")
    tables = 'potential, wind = Table("v.csv", "x", "v"), Table("w.csv", "t", "w")'
    (folder / "tabled.py").write_text(_SIMULATE.format(tables=tables))
    result = codegen.solve(interpreted(folder / "tabled.py"), "fsolve")
    assert result.status == "outside a table"
    assert "in step 28 of 40: t of table w is 2.0625" in result.message


_BODIES = '''"""Three masses in a field that end in a row, with equal distances of their own choice."""

from codegen import Control, Table, body_number, control, coordinates


def problem() -> Control:
    (x, y), (dx, dy) = coordinates("x y")
    f, g, body = control("f"), control("g"), body_number()
    field = {field}
    return Control(
        lagrangian=(dx**2 + dy**2) / 2,
        force={{x: f - field(x), y: g - field(y)}},
        cost=f**2 + g**2 + field(x) ** 2 / 9,
        duration=2,
        start={{x: body / 2, y: 0, dx: 0, dy: 0}},
        end={{dx: 0, dy: 0}},
        end_conditions=[x.of(1) - x.of(0) - 1, x.of(2) - x.of(1) - 1, y.of(0) - 1, y.of(1) - 1, y.of(2) - 1],
        bodies=3,
        steps=8,
    )
'''


def test_bodies_with_tables(folder):
    x = np.linspace(-3, 4, 6)
    np.savetxt(folder / "f.csv", np.stack([x, x**3 / 9 + x / 3], 1), delimiter=",", header="x,f", comments="")
    (folder / "tabled.py").write_text(_BODIES.format(field='Table("f.csv", "x", "f", name="field")'))
    (folder / "written.py").write_text(_BODIES.format(field="lambda x: x**3 / 9 + x / 3"))
    found, exact = (interpreted(folder / name).solve() for name in ("tabled.py", "written.py"))
    assert found.status == exact.status == "solved"
    assert found.cost == pytest.approx(exact.cost, rel=1e-11)
    np.savetxt(folder / "f.csv", np.stack([x / 4, x], 1), delimiter=",", header="x,f", comments="")
    assert re.search(
        r"x of table field is .* of body \d, outside -0.75 to 1", interpreted(folder / "tabled.py").solve().message
    )


def test_a_changed_file_is_seen(tabled, folder, monkeypatch):
    monkeypatch.setenv("CODEGEN_CACHE_DIR", str(folder / "cache"))
    first = codegen.build(tabled)
    assert codegen.build(tabled).cached
    before = (folder / "spring.csv").read_bytes()
    write_tables(folder, stiffness=1.5)
    second = codegen.build(tabled)
    assert not second.cached
    assert second.path != first.path
    (folder / "spring.csv").write_bytes(before)
    third = codegen.build(tabled)
    assert third.cached
    assert third.path == first.path
    assert f"# Reads spring.csv, sha256 {hashlib.sha256(before).hexdigest()}\n" in first.path.read_text()


def test_a_module_needs_no_file(tabled, folder, tmp_path_factory):
    module = codegen.build(tabled, out=folder / "out").path
    cost = codegen.solve(interpreted(tabled)).cost
    for name in ("spring.csv", "drag.csv", "wind.csv"):
        (folder / name).unlink()
    elsewhere = tmp_path_factory.mktemp("elsewhere") / module.name
    elsewhere.write_bytes(module.read_bytes())
    folders = [str(Path(file).parents[1]) for file in (__file__, codegen.__file__)] + [str(Path(__file__).parent)]
    code = f"""import sys; from pathlib import Path; sys.path[:0] = {folders}
from interpreted import without_compilation
print(without_compilation(Path({str(elsewhere)!r}).read_text()).solve().cost)"""
    done = subprocess.run(
        [sys.executable, "-I", "-c", code], capture_output=True, text=True, check=True, cwd=elsewhere.parent
    )
    assert float(done.stdout) == pytest.approx(cost, rel=1e-12)
