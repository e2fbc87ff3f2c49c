"""What may be given other values: particles' parameters come after where they begin, delays are parts of a duration."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from codegen.batch.request import quantities
from codegen.errors import ArgumentError
from codegen.solving.loading import load
from codegen.solving.request import as_number, duration_arguments, parameter_arguments, prescribed_ends, with_values

GENERATED = Path(__file__).parents[2] / "generated"


@pytest.fixture(scope="module")
def atoms():
    return load(GENERATED / "lennard_jones_stormer_verlet.py")


@pytest.mark.parametrize(("name", "index"), [("m", 0), ("eps", 1), ("sigma", 2)])
def test_a_parameter_of_particles_is_the_one_that_was_named(atoms, name, index):
    own = list(atoms.metadata.parameters.values())
    given = with_values(atoms, {name: 2.5}).make_grid(1).parameters
    assert [*given] == [2.5 if k == index else value for k, value in enumerate(own)]
    (varied,) = quantities([name], atoms, ())
    assert varied.key == name
    assert duration_arguments(atoms) == ("duration",)


def test_each_particle_s_own_come_first(interpreted):
    planets = interpreted("outer_solar_system")
    assert planets.metadata.own, "what is tested"
    assert set(parameter_arguments(planets)) == set(planets.metadata.parameters)
    for name, argument in parameter_arguments(planets).items():
        given = with_values(planets, {name: 0.25}).make_grid(1)
        assert argument.rstrip("_") == name
        assert 0.25 in given.parameters


def test_a_duration_of_which_delays_are_parts_is_not_given(interpreted):
    oscillator = interpreted("delayed_oscillator")
    with pytest.raises(ArgumentError, match="has delays, which another duration would change as well"):
        with_values(oscillator, {"duration": 10.0})
    (end,) = {name for name in prescribed_ends(oscillator) if name.startswith("start.q")}
    assert 0.25 in with_values(oscillator, {end: 0.25}).make_grid(2).parameters


@pytest.mark.parametrize("value", ["2", None, True, 10**400, 1j])
def test_what_is_no_number(value):
    assert math.isnan(as_number(value))
