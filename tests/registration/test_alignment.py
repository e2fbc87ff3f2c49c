"""Similarities and affine maps fitted to landmarks: known maps, scikit-image, degenerate landmarks."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from codegen.errors import ArgumentError, LandmarkError
from codegen.registration.pairs import LandmarkPairs, align, flipped

POINTS = np.array([[10.0, 20.0], [200.0, 40.0], [90.0, 160.0], [30.0, 120.0], [150.0, 140.0]])
COORDINATE = st.floats(-500.0, 500.0).map(lambda x: round(x, 4))


def turn(angle, scale=1.0):
    return scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


@given(st.floats(-3.1, 3.1), st.floats(0.05, 20.0), COORDINATE, COORDINATE)
def test_a_similarity_is_found_again(angle, scale, x, y):
    matrix, shift = turn(angle, scale), np.array([x, y])
    found = align(LandmarkPairs(POINTS, POINTS @ matrix.T + shift))
    assert found.kind == "similarity"
    np.testing.assert_allclose(found.matrix, matrix, atol=1e-12 * scale + 1e-13)
    np.testing.assert_allclose(found.shift, shift, atol=1e-9 * max(1.0, scale))
    assert found.determinant == pytest.approx(scale**2, rel=1e-11)


@given(st.tuples(*[st.floats(-0.4, 0.4)] * 4), COORDINATE, COORDINATE)
def test_an_affine_map_is_found_again_and_inverted(entries, x, y):
    matrix, shift = np.eye(2) + np.reshape(entries, (2, 2)), np.array([x, y])
    found = align(LandmarkPairs(POINTS, POINTS @ matrix.T + shift), "affine")
    np.testing.assert_allclose(found.matrix, matrix, atol=1e-12)
    np.testing.assert_allclose(found.apply_inverse(found.apply(POINTS)), POINTS, atol=1e-10)


@given(
    st.lists(
        st.tuples(*[st.integers(-300, 300)] * 4), min_size=3, max_size=12, unique_by=(lambda t: t[:2], lambda t: t[2:])
    )
)
def test_any_landmarks_fit_as_in_scikit_image(rows):
    transform = pytest.importorskip("skimage.transform")
    table = np.array(rows, dtype=float)
    pairs = LandmarkPairs(table[:, :2], table[:, 2:])
    try:
        ours = align(pairs)
    except LandmarkError:  # of a mirrored image, which no similarity is a map of
        assume(False)
    theirs = transform.SimilarityTransform.from_estimate(pairs.moving, pairs.fixed)
    if ours.kind == "similarity" and theirs:
        here = np.linalg.norm(ours.apply(pairs.moving) - pairs.fixed)
        assert here == pytest.approx(np.linalg.norm(theirs(pairs.moving) - pairs.fixed), rel=1e-6, abs=1e-6)


def test_identical_landmarks_give_the_identity_to_the_last_bit():
    for kind in ("none", "similarity", "affine"):
        found = align(LandmarkPairs(POINTS * np.pi, POINTS * np.pi), kind)
        assert found.is_identity
        assert found.apply(POINTS) is POINTS


@pytest.mark.parametrize(
    ("count", "asked", "given_instead"),
    [(1, "similarity", "translation"), (1, "affine", "translation"), (2, "affine", "similarity")],
)
def test_too_few_landmarks_get_a_simpler_map_and_a_message(count, asked, given_instead):
    pairs = LandmarkPairs(POINTS[:count], POINTS[:count] @ turn(0.3).T + [5.0, 1.0])
    found = align(pairs, asked)
    assert found.kind == given_instead
    assert f"{given_instead} instead" in found.message
    np.testing.assert_allclose(found.apply(pairs.moving), pairs.fixed, atol=1e-12 * 300)


def test_collinear_landmarks_get_a_similarity():
    line = np.array([[0.0, 0.0], [10.0, 20.0], [30.0, 60.0], [50.0, 100.0]])
    found = align(LandmarkPairs(line, line @ turn(0.5, 2.0).T), "affine")
    assert found.kind == "similarity"
    np.testing.assert_allclose(found.matrix, turn(0.5, 2.0), atol=1e-12)


def test_mirrored_landmarks_are_refused_at_once():
    square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]) * 50.0
    mirrored = LandmarkPairs(square, square * [-1.0, 1.0] + [70.0, 0.0])
    for kind in ("none", "similarity", "affine"):
        with pytest.raises(LandmarkError, match=r"mirror the image.*--flip"):
            align(mirrored, kind)
    back = flipped(mirrored, 51)
    np.testing.assert_allclose(align(back).matrix, np.eye(2), atol=1e-12)
    with pytest.raises(ArgumentError, match="similarity, affine"):
        align(mirrored, "rigid")


def test_parts_of_a_similarity_compose():
    found = align(LandmarkPairs(POINTS, POINTS @ turn(1.2, 1.7).T + [30.0, -8.0]))
    centre = POINTS.mean(axis=0)
    half = found.part(0.5, centre)
    np.testing.assert_allclose(half.matrix, turn(0.6, 1.7**0.5), atol=1e-13)
    np.testing.assert_allclose(found.part(0.0, centre).apply(POINTS), POINTS, atol=1e-12)
    assert found.part(1.0, centre) is found
