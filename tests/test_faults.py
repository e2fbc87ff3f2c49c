"""Damaged files, full disks and killed processes: the right answer or a typed error, and the next command heals.

`benchmarks/faults.py` does the same at random, at length.
"""

import contextlib
import os
import py_compile
import random
import subprocess
import sys
from pathlib import Path

import pytest
from injected_faults import DAMAGE, Sandbox, alter, cut_off, filled, garble, limited_files, read_only, small_disk

from codegen.emit import rendering
from codegen.errors import FileError
from codegen.files import replacing
from codegen.runtime.kept_code import SEAL, remove_invalid
from codegen.runtime.kernels import identity_of
from codegen.solving.compiler import build
from codegen.solving.loading import load

NAME = "oscillator"


@pytest.fixture(scope="module")
def box(tmp_path_factory):
    made = Sandbox(tmp_path_factory.mktemp("faults"))
    assert made.run("build", NAME) == "right"
    return made


@pytest.mark.parametrize("damage", DAMAGE, ids=lambda damage: damage.__name__)
def test_a_damaged_text_in_the_cache_is_made_anew(tmp_path, monkeypatch, box, damage):
    """It is never copied over the good module."""
    monkeypatch.setenv("CODEGEN_CACHE_DIR", str(tmp_path / "cache"))
    problem = box.folder / f"{NAME}.py"
    cached, module = build(problem).path, build(problem, out=tmp_path / "generated").path
    good = cached.read_text()
    damage(cached, random.Random(1))
    assert cached.read_bytes() != good.encode()
    again = build(problem, out=tmp_path / "generated")
    assert (again.cached, again.written) == (False, False)
    assert cached.read_text() == module.read_text() == good


@pytest.mark.parametrize(
    ("kind", "damage"), [("build", cut_off), ("solve", alter), ("import", cut_off), ("import", garble)]
)
def test_damaged_machine_code_is_found_and_made_anew(box, damage, kind):
    for seed, path in enumerate(box.machine_code()):
        damage(path, random.Random(seed))
    done = subprocess.run(box.command(kind, NAME), cwd=box.folder, env=box.environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert [line for line in done.stderr.splitlines() if "damaged machine code is made anew" in line], done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert box.run("import", NAME) == "right"


def test_machine_code_that_an_import_has_made_carries_its_digest(box):
    """Where one bit is another, the pickle may be read to its end, and LLVM ends the process."""
    for path in box.machine_code():
        path.unlink()
    assert box.run("import", NAME) == "right"
    made = [path for path in box.machine_code() if path.parent.parent.name == "generated"]
    assert made
    for seed, path in enumerate(made):
        alter(path, random.Random(seed))
    command = box.command("import", NAME)
    done = subprocess.run(command, cwd=box.folder, env=box.environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert f"damaged machine code is made anew ({len(made)} files" in done.stderr
    assert not [path for path in made if not path.exists()]


def test_machine_code_of_an_older_text_is_never_run(box):
    """A process that is killed between two writes of numba leaves an index that names the file of an older text."""
    module = load(box.folder / "generated" / f"{NAME}.py")
    identity = identity_of(module.energy.function)
    codes = [path for path in box.machine_code() if path.suffix == ".nbc" and path.parent.parent.name == "generated"]
    assert codes
    assert all(identity.encode() in path.read_bytes() for path in codes)
    older = codes[0].read_bytes().partition(SEAL)[0].replace(identity.encode(), b"x" * len(identity))
    codes[0].write_bytes(older)
    remove_invalid(codes[0].parent, f"{NAME}.", identity)
    assert not codes[0].exists()
    assert all(path.exists() for path in codes[1:])
    assert box.run("import", NAME) == "right"


@pytest.mark.parametrize("left", [4_000, 16_000])
def test_a_part_of_the_bytecode_ends_one_import_at_most(tmp_path, left):
    """Python before 3.13 keeps what a full disk has room for; the first import runs all the same, and removes it."""
    with small_disk(tmp_path / "disk") as mounted:
        if not mounted:
            pytest.skip("no disk could be mounted here")
        box = Sandbox(tmp_path / "disk", {"PYTHONDONTWRITEBYTECODE": ""})
        module = Path(build(box.folder / f"{NAME}.py", out=box.folder / "generated").path)
        words = [sys.executable, "-c", f"import generated.{NAME} as m; print(m.metadata.problem)"]
        for context in (filled(box.folder, left), contextlib.nullcontext()):
            with context:
                done = subprocess.run(words, cwd=box.folder, env=box.environment, capture_output=True, text=True)
            assert (done.returncode, done.stdout.strip()) == (0, NAME), done.stderr
        assert module.parent.joinpath("__pycache__").is_dir()


def test_a_build_removes_bytecode_that_was_cut_off(tmp_path):
    problem = Sandbox(tmp_path).folder / f"{NAME}.py"
    module = build(problem, out=tmp_path / "generated").path
    bytecode = Path(py_compile.compile(str(module), doraise=True))
    build(problem, out=tmp_path / "generated")
    assert bytecode.exists()
    os.truncate(bytecode, bytecode.stat().st_size // 2)
    build(problem, out=tmp_path / "generated")
    assert not bytecode.exists()


def test_texts_know_whether_they_are_whole(box):
    text = box.cached_texts()[0].read_text()
    assert rendering.is_whole(text)
    for other in (text[:-1], text + "\n", text.replace("0", "1", 1), text[: len(text) // 2], ""):
        assert not rendering.is_whole(other)


@pytest.mark.parametrize(("kind", "size"), [("build", 0), ("build", 15_000), ("solve", 10_000)])
def test_files_that_may_not_grow(box, size, kind):
    for path in [*box.cached_texts(), *box.machine_code()]:
        path.unlink()
    assert box.run(kind, NAME, limited_files(size)) == "typed error"
    assert not [path for path in box.folder.rglob(".*.*") if path.is_file()]  # no temporary file stays
    assert box.run(kind, NAME) == "right"


def test_full_and_read_only_disks(tmp_path):
    with small_disk(tmp_path / "disk") as mounted:
        if not mounted:
            pytest.skip("no disk could be mounted here")
        box = Sandbox(tmp_path / "disk")
        with read_only(box.folder):
            assert box.run("build", NAME) == "typed error"
        for left in (0, 60_000):
            with filled(box.folder, left):
                assert box.run("build", NAME) == "typed error"
        assert box.run("solve", NAME) == "right"


def test_a_killed_build_is_no_harm(box):
    for delay in (0.5, 2.0):
        for path in [*box.cached_texts(), *box.machine_code()]:
            path.unlink()
        box.killed("build", NAME, delay, with_compilers=True)
        assert box.run("import", NAME) == "right"
    assert box.run("solve", NAME) == "right"


def test_output_that_finds_no_room(box):
    if not Path("/dev/full").exists():
        pytest.skip("there is no device that is always full")
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            box.command("solve", NAME), cwd=box.folder, env=box.environment, stdout=full, stderr=subprocess.PIPE
        )
    assert done.returncode == 2
    assert done.stderr.decode().splitlines() == [
        f"codegen: error: the output cannot be written ({os.strerror(28)}); make room on that disk, or choose another "
        "folder"
    ]


def test_what_fails_leaves_the_old_file_and_nothing_beside(tmp_path):
    path = tmp_path / "result.csv"
    path.write_text("old")
    code = (
        "import sys; sys.path.insert(0, 'tests'); from injected_faults import limited_files; limited_files(100)();"
        "from pathlib import Path; from codegen.files import write_text\n"
        f"try: write_text(Path({str(path)!r}), 'new' * 1000)\n"
        "except Exception as error: print(type(error).__name__, error)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=Path(__file__).parents[1])
    assert done.stdout.startswith(f"FileError {path} cannot be written")
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_missing_folder_is_named(tmp_path):
    with pytest.raises(FileError, match="No such file"), replacing(tmp_path / "no" / "file.txt"):
        pass
