"""Geodesic distances between specimens: closed forms, axioms of a metric, tables and figures, what is refused."""

import csv
import json

import numpy as np
import pytest
from scipy.spatial.distance import pdist, squareform
from typer.testing import CliRunner

from codegen.cli import main
from codegen.errors import LandmarkError, PointsError
from codegen.registration import register
from codegen.registration.distances import (
    Specimens,
    classical_scaling,
    geodesic_distances,
    read_specimens,
    superimposed,
)
from codegen.registration.pairs import LandmarkPairs

pytestmark = pytest.mark.usefixtures("solver")


def turned(points, angle, scale, shift):
    return scale * points @ np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]) + shift


@pytest.fixture
def specimens():
    """Five noisy copies of twelve points, each elsewhere, of another size and in another direction."""
    generator = np.random.default_rng(8)
    base = generator.uniform(0, 100, (12, 2))
    shapes = [turned(base + generator.normal(size=base.shape) * 4.0, k, 1.0 + k, [50.0 * k, -k]) for k in range(5)]
    return Specimens(np.array(shapes), tuple("abcde"))


def test_the_distance_of_one_landmark_is_the_hyperbolic_one():
    """With G(q, q) = (1 - |q|^2)^2 / 2 the metric is 2 |dq|^2 / (1 - |q|^2)^2: sqrt(2) artanh of a radius."""
    found = register(LandmarkPairs([[49.5, 49.5]], [[79.5, 49.5]]), (100, 100), align="none", steps=64)
    radius = 30.0 / found.matching.frame.radius
    assert found.distance == pytest.approx(np.sqrt(2.0) * np.arctanh(radius), rel=1e-9)


def test_distances_are_a_metric_on_shapes(specimens):
    found = geodesic_distances(specimens)
    assert not found.failed
    np.testing.assert_array_equal(found.table, found.table.T)
    assert (found.table[~np.eye(5, dtype=bool)] > 0.0).all()
    for k in range(5):
        assert (found.table <= found.table[:, k : k + 1] + found.table[k : k + 1] + 1e-9).all()
    again = Specimens(np.array([turned(points, 0.3, 2.0, 7.0) for points in specimens.landmarks[::-1]]), tuple("edcba"))
    np.testing.assert_allclose(geodesic_distances(again).table[::-1, ::-1], found.table, rtol=1e-4)


def test_processes_find_the_same(specimens):
    np.testing.assert_array_equal(geodesic_distances(specimens, workers=2).table, geodesic_distances(specimens).table)


def test_superimposed_copies_are_one(specimens):
    copies = Specimens(np.array([turned(specimens.landmarks[0], k, 1 + k, 3 * k) for k in range(4)]), tuple("abcd"))
    shapes, mean = superimposed(copies)
    np.testing.assert_allclose(shapes, np.broadcast_to(mean, shapes.shape), atol=1e-6)
    mirrored = specimens.landmarks.copy()
    mirrored[3, :, 0] *= -1.0
    with pytest.raises(LandmarkError, match=r"specimen d: .*mirror"):
        superimposed(Specimens(mirrored, tuple("abcde")))


def test_classical_scaling_finds_points_of_the_plane_again():
    points = np.random.default_rng(1).normal(size=(9, 2)) * [3.0, 1.0]
    distances = squareform(pdist(points))
    found, share = classical_scaling(distances)
    np.testing.assert_allclose(squareform(pdist(found)), distances, atol=1e-12)
    assert share == pytest.approx(1.0)


def test_the_command_writes_table_and_figure(specimens, tmp_path):
    file, out, plot = (tmp_path / name for name in ("all.csv", "distances.csv", "all.png"))
    rows = [(name, *point) for name, points in zip("abcde", specimens.landmarks) for point in points]
    with file.open("w", newline="") as stream:
        csv.writer(stream).writerows([("specimen", "x", "y"), *rows])
    ran = CliRunner().invoke(
        main, ["distances", str(file), "--out", str(out), "--plot", str(plot), "--workers", "1", "--json"]
    )
    assert ran.exit_code == 0
    assert json.loads(ran.stdout)["pairs"] == 10
    with out.open(newline="") as stream:
        table = list(csv.DictReader(stream))
    found = geodesic_distances(specimens).table
    assert [row["specimen"] for row in table] == list("abcde")
    assert float(table[1]["d"]) == pytest.approx(found[1, 3], rel=1e-9)
    assert plot.read_bytes()[:4] == b"\x89PNG"


@pytest.mark.parametrize(("text", "said"), [
    ("specimen,x\n", "the columns are specimen,x"), ("specimen,x,y\na,1,2\na,1,z\n", "3: x and y are no numbers"),
    ("specimen,x,y\na,1,2\nb,1,2\n", "2 specimens"),
    ("specimen,x,y\na,1,2\nb,1,2\nc,1,2\nc,3,4\n", "specimen c has 2 landmarks, and a has 1"),
])  # fmt: skip
def test_tables_that_cannot_be_compared_are_refused(tmp_path, text, said):
    file = tmp_path / "all.csv"
    file.write_text(text)
    with pytest.raises(PointsError, match=said):
        read_specimens(file)


def test_specimens_of_a_tps_file_are_read(tmp_path):
    file = tmp_path / "all.tps"
    file.write_text("LM=2\n1 2\n3 4\nID=x\nLM=2\n1 2\n3 5\nIMAGE=b.jpg\nLM=2\n1 2\n3 6\n")
    found = read_specimens(file)
    assert found.names == ("x", "b.jpg", "3")
    assert found.landmarks[2].tolist() == [[1.0, 2.0], [3.0, 6.0]]


def test_the_mean_shape_is_written(specimens, tmp_path):
    file, mean = tmp_path / "all.csv", tmp_path / "mean.csv"
    rows = [(name, *point) for name, points in zip("abcde", specimens.landmarks) for point in points]
    with file.open("w", newline="") as stream:
        csv.writer(stream).writerows([("specimen", "x", "y"), *rows])
    asked = [str(file), "--out", str(tmp_path / "d.csv"), "--mean", str(mean), "--workers", "1"]
    assert CliRunner().invoke(main, ["distances", *asked]).exit_code == 0
    found = np.loadtxt(mean, delimiter=",", skiprows=1)
    assert found[:, 0].tolist() == list(range(1, 13))
    # Of shapes of one size, the mean is the one that the sum of them is a multiple of, after turns onto it.
    assert np.abs(found[:, 1:].mean(axis=0)).max() < 1e-9
    assert (found[:, 1:] ** 2).sum() == pytest.approx(1.0)
    summed = np.zeros(12, complex)
    mean_shape = found[:, 1] + 1j * found[:, 2]
    for points in specimens.landmarks:
        one = points[:, 0] + 1j * points[:, 1]
        one -= one.mean()
        summed += one * np.vdot(one, mean_shape) / np.vdot(one, one).real  # the best similarity
    np.testing.assert_allclose(summed / np.linalg.norm(summed), mean_shape, atol=1e-8)


def test_specimens_without_distances_are_left_out_of_the_picture(specimens, monkeypatch):
    whole = geodesic_distances(specimens)

    def lacking(self, i, j):
        return (np.nan, f"{i} and {j}: none") if 2 in (i, j) and j != 4 else (whole.table[i, j], "")

    monkeypatch.setattr("codegen.registration.distances.DistanceWork._compared", lacking)
    found = geodesic_distances(specimens)
    assert len(found.failed) == 3
    kept = [0, 1, 3, 4]
    np.testing.assert_array_equal(np.isfinite(found.points).all(axis=1), [True, True, False, True, True])
    np.testing.assert_allclose(found.points[kept], classical_scaling(whole.table[np.ix_(kept, kept)])[0])
