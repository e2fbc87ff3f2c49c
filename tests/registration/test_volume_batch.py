"""Batches of volumes: fields and labels of each specimen, failures by name, pictures beside them, what is resumed."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from dask_parts import cluster
from volume_samples import run

from codegen.registration.batch_pairs import Places, jobs_in_folder, jobs_in_table
from codegen.registration.formats import landmark_texts
from codegen.registration.grid import Grid
from codegen.registration.images import read_image, write_image
from codegen.registration.pairs import LandmarkPairs
from codegen.registration.volumes import read_volume, write_volume

itk = pytest.importorskip("SimpleITK")

GRID = Grid((14, 13, 12), (-5.0, 3.0, 8.0), (0.8, 0.9, 1.1), ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), "mm")


def specimen(folder, name, kind, seed, values=None):
    """A volume with landmarks."""
    generator = np.random.default_rng(seed)
    fixed = GRID.to_places(generator.uniform(0.2, 0.8, (8, 3)) * (np.array(GRID.size) - 1))
    pairs = LandmarkPairs(fixed + generator.normal(0.0, 0.15, fixed.shape), fixed)
    samples = generator.integers(0, 900, GRID.shape).astype("i2") if values is None else values
    write_volume(folder / f"{name}{kind}", samples, GRID)
    (folder / f"{name}.csv").write_text(landmark_texts(pairs, "csv")[0])
    return samples


@pytest.fixture
def folder(tmp_path):
    made = tmp_path / "in"
    made.mkdir()
    for k, kind in enumerate((".nii.gz", ".mha", ".mhd", ".nrrd")):
        specimen(made, "abcd"[k], kind, k)
    return made


def lines(summary):
    with summary.open(newline="") as file:
        return {Path(line["moving"]).name: line for line in csv.DictReader(file)}


def test_every_specimen_gets_its_volume_its_field_and_its_page_as_it_does_alone(folder, tmp_path, space_solver):
    out, fields, pages = tmp_path / "out", tmp_path / "fields", tmp_path / "pages"
    asked = [folder, "--out", out, "--field", fields, "--report", pages, "--workers", "2", "--json"]
    record = json.loads(run(*asked).stdout)
    assert (record["pairs"], record["failed"]) == (4, [])
    assert {path.name for path in out.iterdir()} == {"a.nii.gz", "b.mha", "c.mhd", "c.raw", "d.nrrd", "summary.csv"}
    assert {path.name for path in fields.iterdir()} == {f"{name}.nii.gz" for name in "abcd"}
    assert {path.name for path in pages.iterdir()} == {*(f"{name}.html" for name in "abcd"), "index.html"}
    for name in ("a.nii.gz", "c.mhd"):
        stem = name[0]
        alone = [folder / name, "--landmarks", folder / f"{stem}.csv", "--field", tmp_path / "alone.nii.gz"]
        run(*alone, "--out", tmp_path / "alone.nrrd")
        np.testing.assert_array_equal(read_volume(out / name).samples, read_volume(tmp_path / "alone.nrrd").samples)
        both = (itk.ReadImage(str(path)) for path in (fields / f"{stem}.nii.gz", tmp_path / "alone.nii.gz"))
        np.testing.assert_array_equal(*map(itk.GetArrayFromImage, both))
    assert json.loads(run(*asked).stdout)["unchanged"] == 4
    (out / "c.raw").unlink()  # then that specimen is not whole, and is done again
    assert json.loads(run(*asked, "--resume").stdout)["unchanged"] == 3
    assert (out / "c.raw").is_file()


def test_failures_are_listed_by_specimen_and_pictures_go_beside_volumes(folder, tmp_path, solver, space_solver):
    (folder / "b.mha").write_bytes((folder / "b.mha").read_bytes()[:700])
    (folder / "c.csv").write_text((folder / "c.csv").read_text().splitlines()[0] + "\n900,0,0,0,0,0\n")
    (folder / "d.csv").write_text("moving_x,moving_y,fixed_x,fixed_y\n1,1,2,2\n")
    write_image(folder / "e.png", np.zeros((30, 40), np.uint8))
    (folder / "e.csv").write_text("moving_x,moving_y,fixed_x,fixed_y\n10,10,12,11\n30,20,29,18\n5,25,6,24\n")
    done = run(folder, "--out", tmp_path / "out", "--field", tmp_path / "f", "--workers", "1", expect=1)
    found = lines(tmp_path / "out" / "summary.csv")
    statuses = {name: line["status"] for name, line in found.items()}
    wrong = dict.fromkeys(("b.mha", "c.mhd", "d.nrrd"), "wrong input")
    assert statuses == {"a.nii.gz": "solved", "e.png": "solved", **wrong}
    assert "b.mha" in found["b.mha"]["message"]
    assert "lies outside the moving volume" in found["c.mhd"]["message"]
    assert "3 of 5 pairs failed" in done.stderr
    written = {path.name for place in ("out", "f") for path in (tmp_path / place).iterdir()}
    assert written == {"a.nii.gz", "e.png", "e.npz", "summary.csv"}
    assert read_image(tmp_path / "out" / "e.png").shape == (30, 40)


def test_labels_of_a_table_keep_their_values(folder, tmp_path, space_solver):
    labels = np.random.default_rng(5).choice([0, 3, 4000], GRID.shape).astype("u2")
    write_volume(folder / "a_labels.nrrd", labels, GRID)
    table, warped = folder / "labels.csv", tmp_path / "warped labels.nrrd"
    own = f"a.nii.gz,a.csv,{tmp_path / 'a.nrrd'},\na_labels.nrrd,a.csv,{warped},"
    table.write_text(f"moving,landmarks,out,interpolation\n{own}nearest\n")
    run(table, "--workers", "1")
    assert set(np.unique(read_volume(warped).samples)) == {0, 3, 4000}
    found = lines(folder / "labels.summary.csv")
    assert {name: line["interpolation"] for name, line in found.items()} == {
        "a.nii.gz": "linear", "a_labels.nrrd": "nearest"
    }  # fmt: skip
    # Another interpolation is another result, although nothing else of the pair has changed.
    table.write_text(f"moving,landmarks,out,interpolation\n{own}linear\n")
    assert json.loads(run(table, "--workers", "1", "--json").stdout)["unchanged"] == 1
    assert len(np.unique(read_volume(warped).samples)) > 3


def test_workers_of_a_cluster_make_the_volumes_and_fields_of_one_process(folder, tmp_path, monkeypatch, space_solver):
    monkeypatch.chdir(tmp_path)
    run(folder, "--out", "one", "--field", "one fields", "--workers", "1")
    with cluster() as (address, _, _):
        asked = [folder, "--out", "many", "--field", "many fields", "--cluster", address, "--json"]
        record = json.loads(run(*asked).stdout)
    assert (record["pairs"], record["failed"]) == (4, [])
    for kind in ("", " fields"):
        one, many = (
            {path.name: path.read_bytes() for path in Path(f"{name}{kind}").iterdir() if path.suffix != ".csv"}
            for name in ("one", "many")
        )
        assert one == many
        assert len(one) >= 4


def test_files_of_one_specimen_belong_together_whatever_the_ending(folder, tmp_path):
    (folder / "a.csv").unlink()
    for side in ("moving", "fixed"):
        (folder / f"a.{side}.fcsv").write_text("")
    write_volume(folder / "h.nrrd", np.zeros(GRID.shape, "u1"), GRID)
    (folder / "h.nrrd").rename(folder / "h.nhdr")
    (folder / "h.csv").write_text("")
    jobs, without = jobs_in_folder(folder, Places(tmp_path / "o", tmp_path / "f", tmp_path / "r"), folder, ())
    names = {job.moving.name: [path.name for path in job.written] for job in jobs}
    assert names["a.nii.gz"] == ["a.nii.gz", "a.html", "a.nii.gz"]
    assert names["c.mhd"] == ["c.raw", "c.nii.gz", "c.html", "c.mhd"]
    assert names["h.nhdr"] == ["h.nii.gz", "h.html", "h.nrrd"]  # headers alone are not written
    assert [path.name for path in jobs[0].landmarks] == ["a.moving.fcsv", "a.fixed.fcsv"]
    assert {job.fixed for job in jobs} == {folder / job.moving.name for job in jobs}
    assert without == []
    (folder / "t.csv").write_text("moving,landmarks\nb.mha,b.csv\n")
    (job,) = jobs_in_table(folder / "t.csv", Places(tmp_path), None)
    assert job.out == tmp_path / "b.mha"
