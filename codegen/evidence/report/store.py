"""What has been measured, one JSON object a line: a case that is stored already is not measured again."""

from __future__ import annotations

import csv
import io
import json
import math
import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

Values = Mapping[str, Any]


@dataclass(frozen=True)
class Case:
    """One thing to measure: a section of the report, a name that is unique there, and what measures it."""

    section: str
    name: str
    measure: Callable[[], Values]


class Store:
    """The measured values of all cases, kept in a file of JSON lines; lines that are damaged are measured again."""

    def __init__(self, path: Path) -> None:
        """Read what is there."""
        self.path, self._known = path, dict[tuple[str, str], Values]()
        if path.is_file():
            for line in path.read_text(encoding="utf-8").splitlines():
                try:
                    row = json.loads(line)
                    self._known[row["section"], row["case"]] = row["values"]
                except (ValueError, KeyError, TypeError):
                    continue  # a run was killed while it wrote this line

    def measured(self, case: Case) -> bool:
        """Measure a case unless that has been done; return whether it was."""
        if (case.section, case.name) in self._known:
            return False
        values = {key: _plain(value) for key, value in case.measure().items()}
        self._known[case.section, case.name] = values
        with self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps({"section": case.section, "case": case.name, "values": values}) + "\n")
            file.flush()
            os.fsync(file.fileno())
        return True

    def get(self, section: str, name: str) -> Values | None:
        """The values of a case, None if it was not measured."""
        return self._known.get((section, name))

    def rows(self, section: str) -> Iterator[tuple[str, Values]]:
        """Names and values of a section, in the order in which they were measured."""
        yield from ((name, values) for (of, name), values in self._known.items() if of == section)

    def table(self) -> str:
        """Every number as CSV: section, case, quantity, value; arrays have one row for each entry."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(["section", "case", "quantity", "value"])
        for (section, name), values in self._known.items():
            for quantity, value in values.items():
                writer.writerows([section, name, key, number] for key, number in _entries(quantity, value))
        return text.getvalue()


def _entries(quantity: str, value: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(value, dict):
        for name, entry in value.items():
            yield from _entries(f"{quantity}.{name}", entry)
        return
    if not isinstance(value, list):
        yield quantity, "" if value is None else value
        return
    for index, entry in enumerate(value):
        yield from _entries(f"{quantity}[{index}]", entry)


def _plain(value: Any) -> Any:
    """Numbers and lists that JSON has; what is not finite becomes null."""
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, (list, tuple)):
        return [_plain(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
