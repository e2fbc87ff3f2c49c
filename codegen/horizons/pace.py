"""What the parts of a sampling time take, learned from those that were measured, so that deadlines are kept.

A search that a deadline ends asks at every iterate whether there is time for what comes next: an iteration, and the
verdict on what it leads to. What that takes differs from problem to problem, and from hour to hour on a busy machine.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from statistics import median

MOST = 0.75
"""Part of what is measured that stays below what is expected: a larger one follows what others do on a busy machine."""
MARGIN = 1.05
"""Times what is expected is the time without which no iteration begins: as much as most of the others take."""
RATE = 0.02
"""By which an expectation changes with a measurement: a fall is 1 - MOST of it, a rise MOST of it."""
IN_TURN = 4
"""Measurements above what is expected that may follow each other by chance, or after a push; each that follows counts
once more than the one before it, as on a machine that has become slower."""
FORGOTTEN = 0.02
"""Part of its distance from the quickest by which an expectation falls where nothing was measured for lack of time."""


class Expectation:
    """What a part of a step takes: `seconds` that most of those measured lately stay below.

    It is a quantile followed by steps in the logarithm whose size does not depend on how far measurements are away, so
    that one without limit, as of a process that had to wait, counts no more than another. Source: Robbins and Monro
    (1951), A stochastic approximation method. `least` is the quickest ever.
    """

    def __init__(self, measured: Iterable[float]) -> None:
        measured = tuple(measured)
        self.seconds, self.least = median(measured), min(measured)
        self._above = 0

    def learn(self, seconds: float) -> None:
        """Take account of a measurement."""
        self.least = min(self.least, seconds)
        self._above = self._above + 1 if seconds > self.seconds else 0
        rise = MOST * max(1, self._above - IN_TURN)
        self.seconds *= math.exp(RATE * (rise if self._above else MOST - 1.0))

    def forget(self) -> None:
        """There was no time, and so no measurement: come closer to the quickest, or there never would be one again.

        Measurements that follow each other above what is expected still do so: each time more time passes until the
        next.
        """
        self.seconds += FORGOTTEN * (self.least - self.seconds)


class Pace:
    """What is expected of steps: of their `beginning`, up to the first iterate, and of an iteration with the `rest`.

    That is all up to the inputs. Both are made of what was `measured`: pairs of their seconds.
    """

    def __init__(self, measured: Iterable[tuple[float, float]]) -> None:
        beginnings, rests = zip(*measured, strict=True)
        self.beginning, self.rest = Expectation(beginnings), Expectation(rests)

    def limit(self, seconds: float) -> float:
        """How long a search may begin iterations if there are so many `seconds`; negative where it is not to begin."""
        limit = seconds - MARGIN * self.rest.seconds
        return limit if limit >= self.beginning.seconds else -math.inf

    def learn(self, beginning: float | None, rest: float | None, was_late: bool) -> None:
        """Take account of a step, of parts that it had: `was_late` where others lacked for want of time."""
        for expectation, seconds in ((self.beginning, beginning), (self.rest, rest)):
            if seconds is not None:
                expectation.learn(seconds)
            elif was_late:
                expectation.forget()
