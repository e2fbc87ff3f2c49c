"""What stands on axes: names of quantities as mathematics, with the units that their author gave them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from codegen.plots.style import label
from codegen.solutions.result import Result


@dataclass(frozen=True)
class Units:
    """Units by names of quantities, as texts; `t` is the time, `energy` the energy. What is missing has none."""

    by_name: Mapping[str, str]

    @classmethod
    def of(cls, result: Result, time: str = "") -> Units:
        """Those of a result; `time` is what else is known of the unit of the time."""
        return cls({**({"t": time} if time else {}), **result.units})

    @property
    def time(self) -> str:
        """The label of an axis of time."""
        return self.named("time", "t")

    def label(self, name: str) -> str:
        """The label of an axis of a quantity."""
        return self.named(label(name), name)

    def named(self, text: str, name: str) -> str:
        """A text for a quantity, with its unit."""
        unit = self.by_name.get(name, "")
        return f"{text} ({unit})" if unit else text
