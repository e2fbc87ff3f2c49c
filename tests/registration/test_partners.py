"""Landmarks in another order in one of the files: refused by their names, in the plane and in space."""

import numpy as np
import pytest
from noisy_landmarks import noisy_pairs

from codegen.errors import RegistrationError
from codegen.registration import register
from codegen.registration.matching import partners, said_of_partners
from codegen.registration.pairs import LandmarkPairs

SHAPE = (512, 512)


def in_space(count, seed):
    """Landmarks of a smooth map in a cube of 60 millimetres."""
    fixed = np.random.default_rng(seed).uniform(0.0, 60.0, (count, 3))
    return LandmarkPairs(fixed + 2.0 * np.sin(fixed[:, [1, 2, 0]] / 15.0), fixed)


@pytest.mark.parametrize("pairs", [noisy_pairs(20, 1.0, 1), noisy_pairs(60, 1.0, 2), in_space(20, 3)])
@pytest.mark.parametrize("turn", [0.0, 0.6, 2.0])
def test_partners_are_found_whatever_the_order_and_the_turn(pairs, turn):
    order = np.random.default_rng(4).permutation(len(pairs))
    cosine, sine = np.cos(turn), np.sin(turn)
    matrix = np.eye(pairs.dimension)
    matrix[:2, :2] = [[cosine, sine], [-sine, cosine]]
    permuted = LandmarkPairs(pairs.moving, (pairs.fixed @ matrix)[order])
    np.testing.assert_array_equal(order[partners(permuted)], np.arange(len(pairs)))


def test_pairs_that_belong_together_have_no_other_partners():
    assert said_of_partners(noisy_pairs(40, 3.0, 1)) == ""
    generator = np.random.default_rng(0)
    for count in (3, 6, 20, 40):  # shaken by as much as they are apart
        moving = generator.uniform(30.0, 480.0, (count, 2))
        assert said_of_partners(LandmarkPairs(moving, moving + generator.normal(size=(count, 2)) * 40.0)) == ""
    mirrored = LandmarkPairs(moving, moving * [-1.0, 1.0])
    assert partners(mirrored) is None or said_of_partners(mirrored)


def test_two_that_have_changed_places_are_named():
    pairs = noisy_pairs(20, 1.0, 1)
    order = np.arange(20)
    order[[4, 11]] = 11, 4
    assert said_of_partners(LandmarkPairs(pairs.moving, pairs.fixed[order])) == (
        "landmarks 5 and 12 seem to have changed places"
    )


@pytest.mark.parametrize("sigma", [0.0, 20.0])
def test_a_registration_in_another_order_is_refused_by_name(solver, sigma):
    pairs = noisy_pairs(20, 0.0, 3)
    order = np.roll(np.arange(20), 7)
    said = r"20 of 20 landmarks fit others' partners better \(moving 1 with 8, 2 with 9, .* in the same order"
    with pytest.raises(RegistrationError, match=said):
        register(LandmarkPairs(pairs.moving, pairs.fixed[order]), SHAPE, sigma=sigma)
