"""Where a person reads on about how something ended: the page of the documentation that explains every status."""

from __future__ import annotations

PAGE = "Statuses and errors"
"""Its title, which the site's search finds; `docs/guide/statuses.md` in the sources."""


def on_statuses(*statuses: str) -> str:
    """The end of a line about failures: the page, and what to look for there."""
    return f'; the guide explains {", ".join(statuses)}: see "{PAGE}"'
