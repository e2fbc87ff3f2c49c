"""Where the solver's problem is found: in a checkout, and in what a wheel holds."""

import tomllib
from pathlib import Path
from types import SimpleNamespace

import pytest
from made_records import connect_record

from codegen.errors import ModuleError, SchemeError
from codegen.registration import solver as place

ROOT = Path(__file__).parents[2]


def test_the_wheel_has_the_problem_where_it_is_looked_for(tmp_path, monkeypatch):
    wheel = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["build"]["targets"]["wheel"]
    gallery = tmp_path / wheel["force-include"]["problems"]
    monkeypatch.setattr(place, "__file__", str(tmp_path / "codegen" / "registration" / "solver.py"))
    with pytest.raises(ModuleError, match="missing from the installation"):
        place.problem_file()
    for name in ("image_registration.py", "data/trilobite40.csv"):
        (gallery / name).parent.mkdir(parents=True, exist_ok=True)
        (gallery / name).write_bytes((ROOT / "problems" / name).read_bytes())
    found = place.problem_file()
    assert found.read_bytes() == (ROOT / "problems" / "image_registration.py").read_bytes()
    assert (found.parent / "data" / "trilobite40.csv").is_file()


def test_a_checkout_uses_its_own_problem():
    assert place.problem_file() == ROOT / "problems" / "image_registration.py"


def test_schemes_without_steps_of_their_own_are_refused_before_anything_is_compiled(tmp_path, monkeypatch):
    made = SimpleNamespace(metadata=connect_record(adaptive="dop853", passive=True))
    monkeypatch.setattr("codegen.solving.compiler.build", lambda *_, **__: SimpleNamespace(path=tmp_path / "module.py"))
    monkeypatch.setattr(place, "load", lambda path: made)
    with pytest.raises(SchemeError, match="dop853"):
        place.registration_module.__wrapped__("dop853")
