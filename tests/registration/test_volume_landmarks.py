"""Landmarks in space in the files of other programs, and what those mean by their numbers."""

import json

import numpy as np
import pytest
from volume_samples import FIXED, MOVING, pairs_of

from codegen.registration.formats import landmark_texts, parse_landmarks
from codegen.registration.formats.base import Frames


def frames():
    return Frames(grids=(MOVING, FIXED))


@pytest.mark.parametrize("form", ["csv", "bigwarp", "elastix", "slicer", "fcsv"])
def test_landmarks_in_space_are_written_and_read(form):
    pairs = pairs_of()
    texts = landmark_texts(pairs, form, frames())
    suffix = {"csv": "csv", "bigwarp": "csv", "elastix": "pts", "slicer": "mrk.json", "fcsv": "fcsv"}[form]
    contents = [(f"{k}.{suffix}", text.encode()) for k, text in enumerate(texts)]
    again = parse_landmarks(contents, frames=frames())
    np.testing.assert_allclose(again.moving, pairs.moving, atol=1e-12)
    np.testing.assert_allclose(again.fixed, pairs.fixed, atol=1e-12)


def test_what_programs_mean_by_their_numbers():
    """3D Slicer in RAS, elastix in indices, BigWarp in spacings from the first voxel."""
    place = MOVING.to_places(np.array([[3.0, 5.0, 7.0]]))[0]
    x, y, z = place
    markup = {"markups": [{"coordinateSystem": "RAS", "controlPoints": [{"label": "a", "position": [-x, -y, z]}]}]}
    both = [(name, json.dumps(markup).encode()) for name in ("a.mrk.json", "b.mrk.json")]
    np.testing.assert_allclose(parse_landmarks(both, frames=frames()).moving, [place])
    fcsv = f"# CoordinateSystem = 0\na,{-x!r},{-y!r},{z!r},0,0,0,1,1,1,0,a,,\n".replace("np.float64(", "").replace(
        ")", ""
    )
    both = [(name, fcsv.encode()) for name in ("a.fcsv", "b.fcsv")]
    np.testing.assert_allclose(parse_landmarks(both, frames=frames()).moving, [place])
    index = [("a.pts", b"index\n1\n3 5 7\n"), ("b.pts", b"index\n1\n3 5 7\n")]
    found = parse_landmarks(index, frames=frames())
    np.testing.assert_allclose(found.moving, [place])
    np.testing.assert_allclose(found.fixed, FIXED.to_places(np.array([[3.0, 5.0, 7.0]])))
    row = f'"Pt-0","true","{3 * 0.9}","{5 * 0.9}","{7 * 1.6}","3.0","{5 * 0.9}","{7 * 1.5}"\n'
    found = parse_landmarks([("a.csv", row.encode())], frames=frames())
    np.testing.assert_allclose(found.moving, [place])
    np.testing.assert_allclose(found.fixed, FIXED.to_places(np.array([[3.0, 5.0, 7.0]])))
