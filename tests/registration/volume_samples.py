"""Two small volumes that lie obliquely, with landmarks, and `codegen warp` of them."""

import numpy as np
from typer.testing import CliRunner

from codegen.cli import main
from codegen.registration.formats import landmark_texts
from codegen.registration.grid import Grid
from codegen.registration.pairs import LandmarkPairs
from codegen.registration.volumes import write_volume

C, S = np.cos(0.3), np.sin(0.3)
OBLIQUE = ((C, -S, 0.0), (S, C, 0.0), (0.0, 0.0, 1.0))
MOVING = Grid((30, 26, 20), (-12.0, 31.5, -40.0), (0.9, 0.9, 1.6), OBLIQUE, "mm")
FIXED = Grid((28, 27, 22), (-10.0, 30.0, -41.0), (1.0, 0.9, 1.5), OBLIQUE, "mm")


def waves(points):
    """Where the place of a fixed voxel comes from: about a millimetre away."""
    x, y, z = points.T
    return points + np.stack([np.sin(y / 7), np.cos(z / 8), 1.2 * np.sin((x + z) / 9)], axis=1)


def texture(points):
    x, y, z = points.T
    return 500 + 200 * np.sin(x / 2.5) * np.cos(y / 3) + 150 * np.sin(z / 3)


def volume(grid, function=texture, kind="i2"):
    return function(grid.samples(99)).reshape(grid.shape).astype(kind)


def pairs_of(count=12):
    fixed = FIXED.to_places(np.random.default_rng(0).uniform(0.15, 0.85, (count, 3)) * (np.array(FIXED.size) - 1))
    return LandmarkPairs(waves(fixed), fixed)


def table(path, pairs):
    text = landmark_texts(pairs, "csv")[0]
    path.write_text(text)
    return path


def filled(folder):
    """The folder with a volume, another that it is warped to, and a table of landmarks."""
    write_volume(folder / "moving.nii.gz", volume(MOVING), MOVING)
    write_volume(folder / "fixed.mha", volume(FIXED, lambda p: texture(waves(p))), FIXED)
    table(folder / "pairs.csv", pairs_of())
    return folder


def run(*arguments, expect=0):
    done = CliRunner().invoke(main, ["warp", *map(str, arguments)])
    assert done.exit_code == expect, (done.output, done.exception)
    return done


def refused(*arguments):
    """The one line that says what is wrong with the input."""
    done = run(*arguments, expect=2)
    assert done.stdout == ""
    (line,) = done.stderr.strip().splitlines()
    assert line.startswith("codegen: error: ")
    return line


def asked(files, *more, moving="moving.nii.gz", landmarks="pairs.csv", fixed="fixed.mha", out="out.nii.gz"):
    return [
        files / moving, "--landmarks", files / landmarks, "--fixed", files / fixed, "--out", files / out, *more,
    ]  # fmt: skip
