"""The motion of a problem with delays, assembled from its segments.

The motion of a problem with delays is cut into M segments of equal duration, which are solved together
(`codegen.discretise.model.delays`). The module has a column for each quantity of each segment. Users see one column for
each quantity, over the whole duration.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np

from codegen.runtime.record import ControlRecord, Kind, Method, Record
from codegen.solving.loading import Matrix, Vector
from codegen.solving.results.result import Result

_STEM = r"(?:joined|pi|lambda|mu|nu|p|start|end)_"
"""Regular expression of the prefixes that multipliers, momenta and linking variables have before a quantity's name."""


@dataclass(frozen=True)
class Segments:
    """The segments of a problem with delays, and conversions from the module's columns to the user's quantities.

    `number` is the number of segments. `names` maps the name of a quantity in the module to its name in the user's
    problem and to the number of its segment, from 1.
    """

    number: int
    names: Mapping[str, tuple[str, int]]

    def steps(self, total: int) -> int:
        """Return the number of intervals of each segment, rounded up, if the whole motion has `total` intervals."""
        return -(-total // self.number)

    def columns(self, names: Sequence[str]) -> tuple[tuple[str, ...], np.ndarray]:
        """Return the names of the user's quantities, and the indices (segments, quantities) of their columns.

        `names` are the names of the columns in the module.
        """
        indices: dict[str, list[int]] = {}
        for index, name in enumerate(names):
            indices.setdefault(self.split(name)[0], []).append(index)
        return tuple(indices), np.array([*indices.values()], dtype=int).reshape(-1, self.number).T

    def in_order(self, table: Matrix, columns: np.ndarray, at_nodes: bool) -> Matrix:
        """Return the table of the whole motion, with the rows of all segments one after the other.

        Row i of `columns` has the indices of the columns of `table` that belong to segment i. If `at_nodes` is True,
        the rows are values at nodes. The first node of each later segment is then omitted, because it coincides with
        the last node of the segment before.
        """
        return np.concatenate([table[int(at_nodes and i > 0) :, row] for i, row in enumerate(columns)])

    def times(self, t: Vector) -> Vector:
        """Return the times of all nodes of the whole motion; `t` are the times of the nodes of the first segment."""
        return np.concatenate([t + 0.0, *(t[1:] + i * (t[-1] - t[0]) for i in range(1, self.number))])

    def text(self, text: str, steps: int, duration: float) -> str:
        """Return a message of the module in terms of the whole motion.

        Names become the names of the user. Nodes, intervals and times are counted from the start of the motion. Each
        segment has `steps` intervals and lasts `duration`.
        """
        named = "|".join(sorted(map(re.escape, self.names), key=len, reverse=True))
        place = r"(?: (?:at node|on interval|of interval) \d+ \(t = [^)]*\))"

        # A violated continuity condition belongs to the time at which its segment ends and the next one begins.
        def at_switch(match: re.Match[str]) -> str:
            name, segment = self.names[match[2]]
            return f"{match[1]}{name} at t = {segment * duration:.3g}"

        text = re.sub(rf"(the continuity of (?:the momentum of )?)({named})\b", at_switch, text)
        pattern = rf"(?:\b((?:{_STEM})*(?:{named})(?:_stage\d+)?)\b| in segment (\d+))([^,;]*?{place})?"
        text = re.sub(pattern, lambda match: self._in_own_names(match, steps, duration), text)
        active = r"(?<=bounds active on )[^;]+"
        return re.sub(active, lambda match: ", ".join(dict.fromkeys(match[0].split(", "))), text)

    def _in_own_names(self, match: re.Match[str], steps: int, duration: float) -> str:
        name, segment = self.split(match[1]) if match[1] else ("", int(match[2]))
        name, rest = name.removeprefix("joined_"), match[3] or ""
        rest = re.sub(r"( in segment \d+)", "", rest)
        rest = re.sub(rf"\b({'|'.join(map(re.escape, self.names))})\b", lambda other: self.names[other[1]][0], rest)

        def shifted(place: re.Match[str]) -> str:
            time = float(place[3]) + (segment - 1) * duration
            return f"{place[1]}{int(place[2]) + (segment - 1) * steps} (t = {time:.3g})"

        return name + re.sub(r"((?:at node|on interval|of interval) )(\d+) \(t = ([^)]*)\)", shifted, rest)

    def split(self, name: str) -> tuple[str, int]:
        """Return the name of a column without its segment, and the number of the segment.

        A name that belongs to no segment is unchanged, and has the number 1.
        """
        inner, stage = re.fullmatch(r"(.+?)((?:_stage\d+)?)", name).groups()  # type: ignore[union-attr]
        stem = ""
        while inner not in self.names and (prefix := re.match(_STEM, inner)):
            stem, inner = stem + prefix[0], inner[prefix.end() :]
        name, segment = self.names.get(inner, (inner, 1))
        return stem + name + stage, segment


def segments_of(metadata: Record) -> Segments | None:
    """Return the segments of a problem with delays from the metadata of its module; None for other problems."""
    record = metadata.segments
    return Segments(record.number, record.names) if record else None


def multiplier_names(metadata: ControlRecord, count: int) -> list[str]:
    """Return the names of the `count` columns of the array `multipliers` of a result."""
    if metadata.method == Method.VARIATIONAL:
        return [f"lambda_{name}" for name in metadata.coordinates]
    names = metadata.interval
    first = next(i for i, name in enumerate(names) if metadata.kind(name) == Kind.STEP)
    return list(names[first : first + count])


def put_together(result: Result, metadata: Record) -> Result:
    """Return the result of a problem with delays with one column for each quantity of the user's problem.

    The columns of `result` are quantities of segments. Results of other problems are returned unchanged.
    """
    segments = segments_of(metadata)
    if segments is None:
        return result
    number, duration = segments.number, float(result.t[-1] - result.t[0])
    assert result.u is not None
    assert result.multipliers is not None
    tables, names = dict[str, Matrix](), dict[str, tuple[str, ...]]()
    for kind, table in (("q", result.q), ("p", result.p), ("u", result.u)):
        names[kind], columns = segments.columns(result.names[kind])
        tables[kind] = segments.in_order(table, columns, at_nodes=kind != "u")
    accuracy = result.accuracy
    if accuracy is not None:
        quantity, segment = segments.split(accuracy.quantity)
        accuracy = replace(
            accuracy,
            quantity=quantity,
            time=accuracy.time + (segment - 1) * duration,
            reason=segments.text(accuracy.reason, result.steps, duration),
            levels=tuple(replace(level, intervals=number * level.intervals) for level in accuracy.levels),
        )
    labels = multiplier_names(cast(ControlRecord, metadata), result.multipliers.shape[1])
    of_multipliers = segments.columns(labels)[1]
    return replace(
        result,
        steps=number * result.steps,
        message=segments.text(result.message, result.steps, duration),
        t=segments.times(result.t),
        q=tables["q"],
        p=tables["p"],
        u=tables["u"],
        multipliers=segments.in_order(result.multipliers, of_multipliers, len(result.multipliers) == result.t.size),
        names=names,
        summary={**result.summary, "duration": number * result.summary["duration"]},
        levels=tuple(put_together(level, metadata) for level in result.levels),
        grid=None if result.grid is None else np.tile(result.grid / number, number),
        accuracy=accuracy,
        by_segments=result,
    )
