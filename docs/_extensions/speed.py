"""Times of the gallery's problems beside those of CasADi with IPOPT, from the figures that are on record."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

from references import ROOT


def speed_section(path: Path) -> list[str]:
    """Times beside those of CasADi with IPOPT, of the cases that are on record."""
    cases = [case for case in read_speed().values() if case["problem"] == path.stem]
    if not cases:
        return []
    rows = [f"| {' | '.join(speed_row(case))} |" for case in cases]
    dates = sorted({case["date"] for case in cases})
    own = cases[-1]["machine"]
    return [
        "## Beside CasADi with IPOPT",
        "",
        "| options | this solver, ms | CasADi, ms | CasADi as compiled C, ms | iterations |",
        "|---|---|---|---|---|",
        *rows,
        "",
        "Warm solves of the same discrete problem from the same guess to the tolerance 1e-8, all built before; "
        f"the least of {cases[-1]['solves']} each, in turn in one run, on {own['processor']} (cores: {own['cores']}), "
        f"CasADi {own['casadi']}, {' and '.join(dates)}. The machine did other work as well, by which long solves "
        "suffer more than short ones. `python tests/benchmarks/gallery_speed.py --site` measures it.",
        "",
    ]


def speed_row(case: dict[str, Any]) -> list[str]:
    """Options, three times with ratios to the first, and iterations."""
    words = [f"--set {key}={value}" for key, value in case["arguments"].items()] + [f"--steps {case['steps']}"]
    own, *others = case["solvers"].values()
    cells = [milliseconds(own)]
    for other in others:
        is_same = own["status"] == other["status"] == "solved" and case["comparable"]
        cells.append(milliseconds(other) + (f" ({other['best'] / own['best']:.1f} times)" if is_same else ""))
    remark = "" if case["comparable"] else "; not the same optimum, or not all solved"
    return [f"`{' '.join(words)}`", *cells, ", ".join(str(each["iterations"]) for each in (own, *others)) + remark]


def ratio() -> str:
    """How many times as long CasADi's virtual machine takes, over the cases that all solved, to the same optimum."""
    cases = [list(case["solvers"].values()) for case in read_speed().values() if case["comparable"]]
    logarithms = [math.log(other["best"] / own["best"]) for own, *others in cases for other in others[:1]]
    mean = math.exp(sum(logarithms) / len(logarithms))
    least, most = math.exp(min(logarithms)), math.exp(max(logarithms))
    return f"{mean:.0f} times as long ({least:.1f} to {most:.0f} times, geometric mean over {len(cases)} cases)"


def milliseconds(solver: dict[str, Any]) -> str:
    """The least time, or how it ended otherwise."""
    return f"{1e3 * solver['best']:.3g}" if solver["status"] == "solved" else solver["status"]


def read_speed() -> dict[str, Any]:
    """What `tests/benchmarks/gallery_speed.py --site` has put down."""
    found: dict[str, Any] = json.loads((ROOT / "docs" / "gallery" / "speed.json").read_text(encoding="utf-8"))
    return found
