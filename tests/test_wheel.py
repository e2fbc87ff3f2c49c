"""The wheel: it has the package and nothing else, and works where there is no checkout."""

import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

import codegen

ROOT = Path(__file__).parents[1]
REGULATOR = '''"""Move a mass from rest to rest. Source: Bryson and Ho (1975), Applied optimal control, section 3.3."""
from codegen import Control, control, coordinates


def problem():
    (x,), (dx,) = coordinates("x")
    u = control("u")
    return Control(lagrangian=dx**2 / 2, force={x: u}, cost=u**2 / 2, duration=1, start={x: 0, dx: 0},
                   end={x: 1, dx: 0}, steps=50)
'''


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "hatchling", "build", "--target", "wheel", "--directory", str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)
    assert done.returncode == 0, done.stderr
    (found,) = folder.glob("*.whl")
    return found


@pytest.fixture(scope="module")
def installed(wheel) -> Path:
    """The folder that the wheel was installed into."""
    folder = wheel.parent / "installed"
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index", "--target", str(folder)]
    subprocess.run([*command, str(wheel)], capture_output=True, check=True)
    return folder


def outside(installed: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Run Python in an empty folder, where it finds the installed package and no checkout."""
    folder = installed.parent / "elsewhere"
    folder.mkdir(exist_ok=True)
    (folder / "mass.py").write_text(REGULATOR, encoding="utf-8")
    paths = {"PYTHONPATH": str(installed), "CODEGEN_CACHE_DIR": str(folder / "cache"), "NUMBA_DISABLE_JIT": "1"}
    return subprocess.run(
        [sys.executable, *words], capture_output=True, text=True, cwd=folder, env=os.environ | paths, check=False
    )


def test_it_has_the_package_and_nothing_else(wheel):
    def tracked(folder):
        command = ["git", "ls-files", folder]
        return subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=True).stdout.split()

    gallery = {name.replace("problems/", "codegen/gallery/", 1) for name in tracked("problems")}
    names = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    assert names == {*tracked("codegen"), *gallery}
    assert "codegen/py.typed" in names
    assert wheel.name.split("-")[1] == codegen.__version__


def test_it_solves_outside_the_checkout(installed):
    """From rest to rest costs 6, the integral of (6 - 12 t)^2/2, up to a part of h^2."""
    done = outside(installed, str(installed / "bin" / "codegen"), "solve", "mass.py", "--json")
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["status"] == "solved"
    assert found["cost"] == pytest.approx(6.0, rel=1e-3)


def test_it_brings_the_gallery(installed):
    done = outside(installed, str(installed / "bin" / "codegen"), "new", "time_to_climb", "--out", "climb")
    assert done.returncode == 0, done.stderr
    folder = installed.parent / "elsewhere" / "climb"
    assert (folder / "data" / "f4_thrust.csv").is_file()
    assert '"data/f4_thrust.csv"' in (folder / "time_to_climb.py").read_text(encoding="utf-8")


def test_it_brings_what_its_parts_read(installed):
    """Styles, templates, the problem of registration, the problems of stress."""
    code = """
import codegen, json
from importlib.resources import files
from codegen.registration.solver import problem_file
from codegen.evidence.stress.families import all_cases
static = files("codegen.registration.app") / "static"
assert all((static / name).is_file() for name in ("index.html", "style.css", "main.js"))
assert problem_file().is_file()
assert all(case.setup.file.is_file() for case in all_cases())
print(codegen.__file__)
"""
    done = outside(installed, "-c", code)
    assert done.returncode == 0, done.stderr
    assert Path(done.stdout.strip()) == installed / "codegen" / "__init__.py"
