"""Films: how many frames, how long, how large, and what is left behind when something fails."""

from __future__ import annotations

import stat
import sys
from itertools import pairwise

import numpy as np
import pytest
from invented_results import picture
from PIL import Image
from typer.testing import CliRunner

from codegen.cli import main, solve
from codegen.drawing import Mass, Scene, Trail
from codegen.errors import ArgumentError
from codegen.show.figures import shapes
from codegen.solving.api import outcome_of
from codegen.solving.request import Request

SWING = '''"""Let a pendulum swing. All quantities are nondimensional."""
from sympy import cos, sin
from codegen import Simulate, canonical_pair
from codegen.drawing import Mass, Rod
def problem():
    q, p = canonical_pair("q", "p")
    bob = sin(q), -cos(q)
    return Simulate(
        hamiltonian=p**2/2 - cos(q), duration=0.5, start={q: 1, p: 0}, steps=8,
        drawing=[Rod((0, 0), bob), Mass(bob, 0.1)],
    )
'''
BARE = SWING.replace("drawing=[Rod((0, 0), bob), Mass(bob, 0.1)],", "").replace("    bob = sin(q), -cos(q)\n", "")


def short(frames: int = 4) -> Scene:
    """A scene of few frames: a disc that moves along a line."""
    t = np.linspace(0.0, 1.0, shapes.FINE * (frames - 1) + 1)
    x = t[None, :]
    return Scene(t, (Trail((x, 0 * x)), Mass((x, 0 * x), 0.1 + 0 * x)))


def gif(path):
    with Image.open(path) as image:
        frames, durations = [], []
        for place in range(image.n_frames):
            image.seek(place)
            frames.append(np.asarray(image.convert("RGB")))
            durations.append(image.info["duration"])
        return frames, durations


class TestTimes:
    @pytest.mark.parametrize(("duration", "seconds"), [(0.01, 2), (1, 2), (2.5, 2.5), (8, 8), (10000, 8)])
    def test_as_long_as_the_motion_within_limits(self, duration, seconds):
        times = shapes.scene_times(np.array([0.0, 0.3 * duration, duration]))
        assert (times[0], times[-1]) == (0.0, duration)
        assert len(times[:: shapes.FINE]) == round(shapes.RATE * seconds) + 1
        np.testing.assert_allclose(np.diff(times), times[1], rtol=1e-9)


class TestGif:
    def test_frames(self, tmp_path):
        shapes.save(short(), "A disc moves.", tmp_path / "a.gif")
        frames, durations = gif(tmp_path / "a.gif")
        assert len(frames) == 4
        assert durations == [40, 40, 40, 1000]
        assert (tmp_path / "a.gif").stat().st_size < 100_000
        height, width, _ = frames[0].shape
        assert height % 2 == width % 2 == 0
        assert 200 < height <= width <= 800
        assert tuple(frames[0][0, 0]) == (255, 255, 255)
        assert all((a != b).any() for a, b in pairwise(frames))

    def test_the_disc_moves_to_the_right(self):
        def middle(frame):
            blue = (frame[:, :, 2].astype(int) - frame[:, :, 0]) > 150
            return np.nonzero(blue)[1].max()

        places = [middle(frame) for frame in shapes.frames(short(), "A disc moves.")]
        assert places == sorted(places)
        assert places[-1] - places[0] > 300

    def test_all_items_and_several_bodies(self):
        scene = picture(20)
        fine = Scene(scene.t, scene.items)
        frames = list(shapes.frames(fine, "Everything."))
        assert len(frames) == len(scene.t[:: shapes.FINE])
        assert frames[0].dtype == np.uint8

    def test_motion_without_numbers(self, tmp_path):
        t = np.linspace(0.0, 1.0, shapes.FINE + 1)
        x = np.full((1, t.size), np.nan)
        shapes.save(Scene(t, (Trail((x, x)), Mass((x, x), x))), "Lost.", tmp_path / "a.gif")
        assert len(gif(tmp_path / "a.gif")[0]) == 2

    def test_progress_sees_every_frame(self, tmp_path):
        seen = []

        def progress(frames, count):
            for frame in frames:
                seen.append(count)
                yield frame

        shapes.save(short(3), "A disc moves.", tmp_path / "a.gif", progress)
        assert seen == [3, 3, 3]

    @pytest.mark.parametrize("size", [(1.0, 0.001), (0.001, 1.0), (1.0, 1.0)])
    def test_shapes_of_scenes(self, size):
        t = np.linspace(0.0, 1.0, shapes.FINE + 1)
        x, y = size[0] * t[None, :], size[1] * t[None, :]
        frame = next(shapes.frames(Scene(t, (Trail((x, y)),)), "Very " * 40))
        assert max(frame.shape) <= 900
        assert min(frame.shape[:2]) >= 250


@pytest.fixture
def encoder(tmp_path, monkeypatch):
    """Puts a program called ffmpeg on the search path."""

    def install(code):
        folder = tmp_path / "bin"
        folder.mkdir()
        program = folder / "ffmpeg"
        program.write_text(f"#!{sys.executable}\nimport sys\n{code}\n")
        program.chmod(program.stat().st_mode | stat.S_IXUSR)
        monkeypatch.setenv("PATH", str(folder))

    return install


class TestMp4:
    def test_what_the_encoder_is_told(self, tmp_path, encoder):
        encoder("open(sys.argv[-1], 'w').write(' '.join(sys.argv[1:-1]) + f' {len(sys.stdin.buffer.read())}')")
        shapes.save(short(), "A disc moves.", tmp_path / "a.mp4")
        words = (tmp_path / "a.mp4").read_text().split()
        width, height = map(int, words[words.index("-s") + 1].split("x"))
        assert width % 2 == height % 2 == 0
        assert words[words.index("-r") + 1] == "25"
        # Four frames, and a second of pause.
        assert int(words[-1]) == (4 + 25) * 3 * width * height

    @pytest.mark.parametrize("reads", ["", "sys.stdin.buffer.read(); "])
    def test_an_encoder_that_fails(self, tmp_path, encoder, reads):
        encoder(f"{reads}print('no codec', file=sys.stderr); sys.exit(3)")
        with pytest.raises(ArgumentError, match=r"ffmpeg could not write the film \(no codec\)"):
            shapes.save(short(), "A disc moves.", tmp_path / "a.mp4")

    def test_an_encoder_without_a_word(self, tmp_path, encoder):
        encoder("sys.exit(4)")
        with pytest.raises(ArgumentError, match="exit status 4"):
            shapes.save(short(), "A disc moves.", tmp_path / "a.mp4")

    def test_no_encoder(self, tmp_path, monkeypatch):
        monkeypatch.setenv("PATH", str(tmp_path))
        with pytest.raises(ArgumentError, match=r"needs the program ffmpeg.*\.gif"):
            shapes.save(short(), "A disc moves.", tmp_path / "a.mp4")
        with pytest.raises(ArgumentError, match=r"--animate .*a.mp4 needs the program ffmpeg.*\.gif"):
            solve.requested(Request(tmp_path / "none.py"), None, tmp_path / "a.mp4")


class TestCommand:
    @pytest.fixture
    def folder(self, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        (tmp_path / "swing.py").write_text(SWING)
        (tmp_path / "bare.py").write_text(BARE)
        return tmp_path

    def run(self, *words):
        return CliRunner().invoke(main, ["solve", *words, "--scheme", "stormer-verlet"])

    def test_film_and_plot(self, folder):
        result = self.run("swing.py", "--animate", "a.gif", "--plot", "a.png")
        assert result.exit_code == 0, result.output
        assert {path.name for path in folder.iterdir()} == {"swing.py", "bare.py", "a.gif", "a.png"}
        frames, durations = gif(folder / "a.gif")
        assert sum(durations) == 2000 + 1000
        assert len(frames) == 51

    @pytest.mark.parametrize(
        ("words", "fragments"),
        [
            ("swing.py --animate a.avi", ["--animate", ".gif or .mp4"]),
            ("swing.py --animate a", ["--animate", ".gif or .mp4"]),
            ("swing.py --animate a.png", ["--animate", ".gif or .mp4"]),
            ("swing.py --animate nowhere/a.gif", ["nowhere"]),
            ("swing.py --plot a.gif", ["--plot", ".png or .pdf or .svg"]),
            ("bare.py --animate a.gif", ["bare.py", "drawing=[...]"]),
            ("none.py --animate a.gif", ["none.py: no such file"]),
        ],
    )
    def test_what_cannot_be_drawn_is_refused_before_anything_is_solved(self, folder, monkeypatch, words, fragments):
        monkeypatch.setattr("codegen.solving.compiler.build", pytest.fail)
        before = {path.name for path in folder.iterdir()}
        result = self.run(*words.split())
        assert result.exit_code == 2
        assert result.stdout == ""
        assert result.stderr.startswith("codegen: error: ")
        assert result.stderr.count("\n") == 1
        assert all(fragment in result.stderr for fragment in fragments), result.stderr
        assert {path.name for path in folder.iterdir()} == before

    def test_a_failed_film_leaves_the_old_one(self, folder, encoder):
        encoder("open(sys.argv[-1], 'w').write('half'); sys.exit(1)")
        (folder / "a.mp4").write_text("old")
        result = self.run("swing.py", "--animate", "a.mp4")
        assert result.exit_code == 2
        assert "ffmpeg could not write" in result.stderr
        assert (folder / "a.mp4").read_text() == "old"
        assert not [path for path in folder.iterdir() if path.name.startswith(".")]

    def test_unit(self, folder):
        assert solve.requested(Request(folder / "swing.py"), folder / "a.png", None).unit == "nondimensional"
        (folder / "swing.py").write_text(SWING.replace("All quantities are nondimensional.", ""))
        assert solve.requested(Request(folder / "swing.py"), folder / "a.png", None).unit == ""

    def test_nothing_wanted_reads_nothing(self, folder):
        assert solve.requested(Request(folder / "none.py"), None, None) == solve.Pictures()


def test_a_generated_module_is_drawn_as_far_as_it_knows_how(tmp_path, pendulum):
    """It has no drawing, which is written in the problem file alone."""
    request = Request(pendulum.__file__, steps=20)
    wanted = solve.requested(request, tmp_path / "a.png", None)
    wanted.save(pendulum, outcome_of(request).result)
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
    with pytest.raises(ArgumentError, match="says nothing about how to draw it"):
        solve.requested(request, None, tmp_path / "a.gif")


def test_no_progress_bar_without_a_terminal():
    frames = iter(())
    assert solve._with_progress(frames, 3) is frames


def test_progress_bar_on_a_terminal(monkeypatch, capsys):
    monkeypatch.setattr("sys.stderr.isatty", lambda: True)
    assert list(solve._with_progress([1, 2, 3], 3)) == [1, 2, 3]
