"""A controller whose inputs act later than at the time of the measurement: it begins where the state will be by then.

Source: Findeisen and Allgoewer (2004), Computational delay in nonlinear model predictive control, IFAC Proceedings
Volumes 37(1).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np

from codegen.horizons.interface import Interface, vector
from codegen.horizons.motion import Motion
from codegen.horizons.values import Values
from codegen.interfaces import Vector


class Delay:
    """The inputs of the last `samples` sampling times, which last `seconds`, and the state that they will lead to."""

    def __init__(self, interface: Interface, values: Values, motion: Motion, samples: int, seconds: float) -> None:
        self._interface, self._values, self._motion = interface, values, motion
        self._samples, self._sample = samples, seconds
        self.reset()

    def reset(self, inputs: Any = None) -> None:
        """Have inputs (controls,) on their way that did not come from the controller, zero unless they are given."""
        names = self._interface.inputs
        before = np.zeros(len(names)) if inputs is None else vector(inputs, names, "the array of inputs")
        self._waiting = deque([before] * self._samples, self._samples)

    def append(self, inputs: Vector) -> None:
        """Send inputs (controls,) on their way; the first of the others have acted by then."""
        self._waiting.append(inputs.copy())

    def state_after(self, state: Vector, t: float, own: Mapping[str, float] | None) -> Vector | None:
        """What the state (states,) of a time t is at the end of the delay; None where its motion cannot be followed.

        Run-time values are those of the times on the way; the controller's `own` hold at all of them.
        """
        given = self._values.given(t, own)
        for k, inputs in enumerate(self._waiting, 1):
            later = self._values.given(t + k * self._sample, own)
            found = self._motion(state, inputs, given, later)
            if found is None:
                return None
            state, given = found, later
        return state


def delay_of(
    module: Any, interface: Interface, values: Values, samples: int, seconds: float, intervals: float
) -> Delay | None:
    """The delay of a controller whose sampling time lasts so many seconds, or `intervals` of its plan; None without."""
    if not samples:
        return None
    return Delay(interface, values, Motion(module, interface, seconds, intervals), samples, seconds)
