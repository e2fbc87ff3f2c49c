"""Landmarks that can and cannot be matched; the disc around both images."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from codegen.errors import LandmarkError
from codegen.registration.grid import Frame, coarse_grid, corners, pixel_grid
from codegen.registration.pairs import LandmarkPairs

PLACES = st.floats(-1e4, 1e4).map(lambda x: round(x, 3))


@pytest.mark.parametrize(
    ("moving", "fixed", "said"),
    [
        ([], [], "no landmarks"),
        ([[0, 0]], [[0, 0], [1, 1]], "1 moving landmarks but 2"),
        ([[0, 0], [1, np.nan]], [[0, 0], [1, 1]], "moving landmark 2 is at (1, nan)"),
        ([[0, 0], [1, 0]], [[0, 0], [np.inf, 1]], "fixed landmark 2"),
        ([[3, 4], [1, 0], [3, 4]], [[0, 0], [1, 1], [2, 2]], "moving landmarks 1 and 3 are at the same place (3, 4)"),
        ([[3, 4], [1, 0]], [[5, 5], [5, 5]], "fixed landmarks 1 and 2"),
        ([[1, 2, 3, 4]], [[1, 2, 3, 4]], "shape (1, 4)"),
        ([[1, 2, 3]], [[1, 2]], "fixed points have shape (1, 2)"),
        ([["a", "b"]], [[1, 2]], "no numbers"),
    ],
)
def test_landmarks_that_no_map_matches_are_refused_by_name(moving, fixed, said):
    with pytest.raises(LandmarkError) as found:
        LandmarkPairs(moving, fixed)
    assert said in str(found.value)


def test_names_follow_the_landmarks():
    pairs = LandmarkPairs([[0, 0], [1, 1], [2, 0]], [[5, 5], [6, 6], [7, 5]], ("eye", "nose", "ear"))
    rest = pairs.without(1)
    assert rest.names == ("eye", "ear")
    np.testing.assert_array_equal(rest.fixed, [[5, 5], [7, 5]])
    np.testing.assert_array_equal(pairs.swapped().moving, pairs.fixed)
    assert LandmarkPairs([[0, 0]], [[1, 1]]).names == ("1",)
    with pytest.raises(LandmarkError, match="2 names for 1"):
        LandmarkPairs([[0, 0]], [[1, 1]], ("a", "b"))


@given(arrays(float, (7, 2), elements=PLACES), st.integers(1, 5000), st.integers(1, 5000), st.floats(0.01, 2.0))
def test_the_disc_contains_all_with_its_margin_and_maps_back(points, height, width, margin):
    everything = np.vstack([corners((height, width)), points])
    frame = Frame.around(everything, margin)
    inside = frame.to_disc(everything)
    assert np.linalg.norm(inside, axis=1).max() == pytest.approx(1.0 / (1.0 + margin), rel=1e-12)
    np.testing.assert_allclose(frame.to_pixels(inside), everything, atol=1e-15 * 4e4)
    assert frame.scale * frame.radius == pytest.approx(1.0)


def test_grids_are_row_by_row_and_reach_the_edges():
    np.testing.assert_array_equal(pixel_grid((2, 3)), [[0, 0], [1, 0], [2, 0], [0, 1], [1, 1], [2, 1]])
    grid = coarse_grid((2, 3), 5)
    assert len(grid) == 25
    np.testing.assert_allclose([grid.min(axis=0), grid.max(axis=0)], [[-0.5, -0.5], [2.5, 1.5]])


@pytest.mark.parametrize("margin", [0.0, -1.0, np.nan, np.inf])
def test_a_disc_needs_a_margin(margin):
    with pytest.raises(LandmarkError, match="margin"):
        Frame.around(corners((3, 3)), margin)
