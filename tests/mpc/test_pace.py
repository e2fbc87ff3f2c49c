"""What controllers expect steps to take, by a clock that the tests move, and the deadlines that are kept by it."""

from __future__ import annotations

import numpy as np
import pytest
from horizon_problems import STEPS, exactly, regulator

import codegen
from codegen.mpc import controller as controllers
from codegen.mpc.acceptance import MOST, BestIterate, Expectation, Pace
from codegen.runtime.search import cascade, descent, first_iterate, workspace
from codegen.runtime.search.iterates import search_on
from codegen.runtime.search.point import evaluate

EVALUATION, ITERATION = 4.0, 19.0
"""What evaluations, and iterations of the compiled search, take by the clock of these tests, but for chance."""


class Clock:
    """Time that passes in evaluations and iterations alone, by chance up to a tenth more than these numbers say."""

    def __init__(self, monkeypatch):
        self.now, self.slowness, self._generator = 0.0, 1.0, np.random.default_rng(5)
        monkeypatch.setattr(codegen.Controller, "_clock", staticmethod(lambda: self.now))
        monkeypatch.setattr(controllers, "evaluate", self.timed(evaluate))
        begin_beside = self.timed(first_iterate.begin_beside)
        for module in (first_iterate, cascade):
            monkeypatch.setattr(module, "begin_beside", begin_beside)
        own = descent.descend

        def descend(*given):
            integers = next(array for array in given if getattr(array, "dtype", None) == np.int64)
            before = integers[workspace.ITERATIONS]
            status = own(*given)
            for _ in range(integers[workspace.ITERATIONS] - before):
                self.passes(ITERATION)
            return status

        monkeypatch.setattr(descent, "descend", descend)

    def passes(self, seconds):
        """Let time pass."""
        self.now += self.slowness * seconds * (1.0 + 0.1 * self._generator.random())

    def timed(self, function):
        """An evaluation that takes time."""

        def called(*given):
            self.passes(EVALUATION)
            return function(*given)

        return called


def followed(controller, count, clock=None, slow=range(0)):
    """The Feedback of so many sampling times, with states by chance; the machine is `slow` for some of them."""
    generator, state, found = np.random.default_rng(7), np.array([1.0, 0.0]), []
    for k in range(count):
        if clock is not None:
            clock.slowness = 2.0 if k in slow else 1.0
        inputs = controller.step(state, k * controller.sample)
        found.append(controller.last)
        state = exactly(state, np.clip(inputs, -1.0, 1.0), 0.0, controller.sample)
        state += 0.03 * generator.standard_normal(2)
    return found


@pytest.fixture
def clock(monkeypatch):
    return Clock(monkeypatch)


def shares(found):
    """Which parts were solved and late; those that were not solved say what was applied."""
    for feedback in found:
        assert feedback.status in ("solved", "time limit")
        if feedback.status != "solved":
            assert "applied is the " in feedback.message
    return np.mean([f.status == "solved" for f in found]), np.mean([not f.in_time for f in found])


def test_with_a_deadline_of_a_median_many_steps_are_solved_and_few_are_late(clock):
    seconds = np.array([f.seconds for f in followed(codegen.Controller(regulator(True)), 150)])
    solved, late = {}, {}
    for part in (0.2, 1.0, 1.1, 3.0):
        controller = codegen.Controller(regulator(True), deadline=part * np.median(seconds))
        solved[part], late[part] = shares(followed(controller, 200))
    assert solved[0.2] == 0.0 < solved[1.1] <= solved[3.0] == 1.0
    assert max(late.values()) <= 0.1
    assert solved[1.1] > 0.5


def test_deadlines_are_kept_again_soon_after_a_machine_is_slower(clock):
    median = np.median([f.seconds for f in followed(codegen.Controller(regulator(True)), 150)])
    controller = codegen.Controller(regulator(True), deadline=1.5 * median)
    found = followed(controller, 300, clock, range(100, 200))
    (quick, _), (_, late), slow, (again, _) = map(shares, (found[:100], found[100:150], found[150:200], found[250:]))
    assert quick > 0.95
    assert 0.0 < late < 0.3  # until it is noticed
    assert slow[0] == 0.0  # an iteration would take longer than there is time
    assert slow[1] < 0.1
    assert again > 0.8


@pytest.mark.parametrize("spread", [0.0, 0.02, 0.3])
def test_most_measurements_stay_below_what_is_expected(spread):
    generator = np.random.default_rng(3)
    expectation, below = Expectation([1.0]), []
    for k in range(20_000):
        seconds = 1.0 + spread * generator.random()
        if generator.random() < 0.02:
            seconds *= 1e4  # the process had to wait
        if k > 1000:
            below.append(seconds <= expectation.seconds)
        expectation.learn(seconds)
    assert np.mean(below) == pytest.approx(MOST, abs=0.05)
    assert expectation.seconds < 1.0 + spread + 0.05


def test_a_machine_that_is_slower_for_a_while_is_noticed_and_forgotten():
    expectation = Expectation([1.0, 1.1, 1.2])
    assert expectation.seconds == 1.1
    for _ in range(100):
        expectation.learn(3.0)
    assert 2.9 < expectation.seconds < 3.1
    for _ in range(400):
        expectation.forget()  # there is no time for what takes three
    assert 1.0 < expectation.seconds < 1.1
    expectation.learn(0.5)
    assert expectation.least == 0.5


def test_a_search_begins_where_there_is_time_for_its_beginning_and_an_iteration():
    pace = Pace([(2.0, 5.0), (3.0, 6.0), (10.0, 100.0)])
    assert pace.limit(9.7) == pytest.approx(9.7 - 1.05 * 6.0)
    assert pace.limit(9.2) == -np.inf
    pace.learn(2.0, None, was_late=True)
    assert pace.beginning.seconds < 3.0
    assert 5.0 < pace.rest.seconds < 6.0


def test_what_an_iteration_and_the_end_took_is_measured():
    now, search = 0.0, search_on(regulator(True).make_grid(STEPS))
    log = BestIterate(20.0, 1.0, lambda: now)
    assert log.rest(1.0) is None
    now = 2.0
    log.iterations_per_call(0, 10, 10)
    assert log.beginning == 2.0
    assert log.rest(3.0) is None  # no iterate has come of it yet
    now = 8.0
    search.work.integers[workspace.ITERATIONS] = 3
    log.extend(search, np.zeros((3, 6)))
    assert log.rest(9.0) == 3.0  # two for the last of three iterations, one for what followed
    assert not log.is_late()
    now = 9.0
    assert not log.is_late()  # a restoration asks, too
    now = 10.0
    log.iterations_per_call(3, 10, 10)
    now = 21.0
    search.work.integers[workspace.ITERATIONS] = 4
    log.extend(search, np.zeros((1, 6)))
    assert log.is_late()
    assert log.was_late
    assert log.rest(22.0) == 12.0
    linear = BestIterate(10.0, 1.0, lambda: now)
    point = type("Point", (), {"residual": 0.0, "cost": 0.0})
    linear.add(point, 0.0)
    now = 22.0
    linear.add(point, 1.0)
    assert linear.rest(22.5) == 1.5
