"""Files of points: what is read, and what is refused with exit status 2."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import PROBLEMS

from codegen.cli import main
from codegen.errors import PointsError
from codegen.problem.points import read_points
from codegen.solving.results.motions import intersecting_paths

HEAD = "x0,y0,x1,y1\n"

UNREADABLE = {
    "empty": ("", "is empty"),
    "blank": ("\n\n", "is empty"),
    "no points": (HEAD, "holds no points"),
    "ragged": (HEAD + "0,0,0.1,0\n0.1,0.2\n", ":3: 2 values for 4 columns"),
    "nan": (HEAD + "0,0,nan,0\n", ":2: x1 is 'nan'"),
    "infinite": (HEAD + "0,0,inf,0\n", "x1 is 'inf'"),
    "words": (HEAD + "0,zero,0.1,0\n", "y0 is 'zero'"),
    "columns": ("a,b\n1,2\n", "the columns are a,b"),
    "unequal": ("x0,y0,x1,y1\n0,0,0.1,0\n0.1,0.1,,\n", "x1 is ''"),
    "column twice": ("x0,y0,x1,y1,x0\n0,0,0,0,0\n", "the columns are"),
    "negative sigma": ("x0,y0,x1,y1,sigma\n0,0,0.1,0,-1\n", "sigma is negative"),
}

UNUSABLE = {
    "outside": (HEAD + "0,0,0.1,0\n1.2,0,0.1,0.3\n", "start of point 2, (1.2, 0), is on or outside"),
    "on the circle": (HEAD + "0,0,0.6,0.8\n", "target of point 1, (0.6, 0.8), is on or outside"),
    "duplicate": (HEAD + "0,0,0.1,0\n0.5,0.1,0.2,0\n0,0,0.3,0\n", "start of points 1 and 3 is the same place"),
    "joined": (HEAD + "0,0,0.1,0\n0.5,0.1,0.1,0\n", "target of points 1 and 2 is the same place"),
}


def written(folder, text):
    path = folder / "points.csv"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return path


def test_points_in_any_order_of_columns(tmp_path):
    found = read_points(written(tmp_path, "sigma, x1,y1,x0,y0\r\n0.1,3,4,1,2\r\n\r\n0,7,8,5,6\r\n"), 2)
    np.testing.assert_array_equal(found.start, [[1, 2], [5, 6]])
    np.testing.assert_array_equal(found.target, [[3, 4], [7, 8]])
    np.testing.assert_array_equal(found.sigma, [0.1, 0.0])


def test_points_in_space(tmp_path):
    found = read_points(written(tmp_path, "x0,y0,z0,x1,y1,z1\n1,2,3,4,5,6\n"), 3)
    np.testing.assert_array_equal(found.target, [[4, 5, 6]])


@pytest.mark.parametrize("name", UNREADABLE)
def test_unreadable_files(tmp_path, name):
    text, finding = UNREADABLE[name]
    with pytest.raises(PointsError) as raised:
        read_points(written(tmp_path, text), 2)
    assert finding in str(raised.value)


def test_no_text(tmp_path):
    with pytest.raises(PointsError, match="cannot be read"):
        read_points(written(tmp_path, b"\xff\xfe\x00x"), 2)


def test_no_file(tmp_path):
    with pytest.raises(PointsError, match="no such file"):
        read_points(tmp_path / "absent.csv", 2)


def test_a_million_points_are_refused_before_they_are_parsed(tmp_path):
    path = written(tmp_path, HEAD + "0,0,0,0\n" * 1_000_000)
    with pytest.raises(PointsError, match="1000001 points, whose matrix of interactions takes 8000 GB"):
        read_points(path, 2)


@pytest.mark.parametrize("name", [*UNREADABLE, *UNUSABLE])
def test_exit_status_two(tmp_path, capsys, name):
    text, finding = {**UNREADABLE, **UNUSABLE}[name]
    path = written(tmp_path, text)
    with pytest.raises(SystemExit) as ended:
        main(
            [
                "solve",
                str(PROBLEMS / "image_registration.py"),
                "--scheme",
                "explicit-euler",
                "--set",
                f"landmarks={path}",
            ]
        )
    assert ended.value.code == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert finding in captured.err
    assert len(captured.err.splitlines()) == 1


def test_crossing_ways_are_found():
    """The diagonals of a square cross; its sides only touch, and a segment that stops short of another does not."""
    start = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 0.0], [0.6, 0.5]])
    target = np.array([[1.0, 1.0], [0.0, 1.0], [1.0, 0.0], [0.9, 0.5]])
    assert intersecting_paths(start, target) == [(1, 2)]
    assert intersecting_paths(np.c_[start, start[:, :1]], np.c_[target, target[:, :1]]) == []
