"""The page on benchmarks: tables and pictures of the measurements that are on record, which are not made here."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from references import ROOT
from speed import ratio, read_speed

from codegen.show.figures.picture import AMBER, BLUE, DARK, GREEN, GREY, PINK, RED, SKY, Picture, using

MEASURED = ROOT / "docs" / "measured"
_OURS, _THEIRS = "codegen", "IPOPT"
_COLOURS = (BLUE, RED, GREEN, PINK, AMBER, SKY, DARK, GREY)
_ALL_STRESS = 500
"""`codegen stress --all` has more cases, and `--quick` fewer."""
_DASHES = ("-", "--", ":", "-.")


def page() -> str:
    """The page, in MyST."""
    front = (ROOT / "docs" / "benchmarks.in").read_text(encoding="utf-8")
    parts = {
        **gallery_parts(),
        "RATIO": ratio(),
        "PEERS": picture("peers", peers()),
        "REPORTS": "\n".join(reports()),
        "ROBUSTNESS": robustness(),
        "STRESS": stress(),
    }
    for name, text in parts.items():
        front = front.replace(f"@{name}@", text)
    return front


def picture(name: str, figure: Figure) -> str:
    """A figure as a file beside the records, and the directive that shows it with the words of what it shows."""
    shown = Picture(figure)
    path = MEASURED / f"{name}.svg"
    shown.save(path)
    return f"```{{image}} measured/{name}.svg\n:alt: {shown.text}\n:class: figure-card\n:loading: lazy\n```\n"


def gallery_parts() -> dict[str, str]:
    """Rows and machine of the figures that `tests/figures.py` keeps of the newest version."""
    record = json.loads(newest_figures().read_text(encoding="utf-8"))
    own = record["environment"]
    rows = [
        f"| `{case['case']}` | {case['iterations']} | {1e3 * case['seconds']:.3g} | {case['lines']} |"
        for case in record["cases"]
    ]
    machine = (
        f"{own['processors']} cores of {own['processor']}, Python {own['python']}, numba {own['numba']}, numpy "
        f"{own['numpy']}, at a load of {own['load of the machine when the page was made']}"
    )
    return {"ROWS": "\n".join(rows), "MACHINE": machine}


def newest_figures() -> Path:
    """The record that `tests/figures.py` keeps of the newest version."""
    return max((ROOT / "tests" / "figures").glob("*.json"), key=lambda path: [int(n) for n in path.stem.split(".")])


def read(name: str) -> dict[str, Any]:
    """A record of `docs/keep.py`."""
    found: dict[str, Any] = json.loads((MEASURED / f"{name}.json").read_text(encoding="utf-8"))
    return found


def said(record: dict[str, Any]) -> str:
    """When and on what something was measured."""
    own = record["machine"]
    load = f", at a load of {record['load']}" if "load" in record else ""
    return (
        f"Measured on {record['date']} with codegen {own['codegen']} on {own['processors']} cores of "
        f"{own['processor']}, Python {own['python']}, numba {own['numba']}, numpy {own['numpy']}{load}."
    )


def titled(figure: Figure, title: str) -> None:
    """A title for readers, and for the words of the picture."""
    figure.suptitle(title)
    figure.set_label(title)


def peers() -> Figure:
    """How many times as long CasADi with IPOPT takes, case by case."""
    cases = [(name, list(case["solvers"].values())) for name, case in read_speed().items() if case["comparable"]]
    cases.sort(key=lambda case: case[1][1]["best"] / case[1][0]["best"])
    with using("page"):
        figure = Figure(figsize=(9.0, 0.24 * len(cases) + 1.4), layout="constrained")
        axes = figure.add_subplot()
        for place, (name, colour) in enumerate((("its virtual machine", BLUE), ("compiled to C", AMBER)), start=1):
            times = [solvers[place]["best"] / solvers[0]["best"] for _, solvers in cases]
            axes.plot(times, range(len(cases)), "o", color=colour, markersize=5, label=name)
        axes.set_yticks(range(len(cases)), [name for name, _ in cases], fontsize=8)
        axes.axvline(1.0, color=GREY, linewidth=0.9)
        axes.set_xscale("log")
        axes.set_xticks([1, 2, 5, 10, 20], ["1", "2", "5", "10", "20"])
        axes.set_xlabel("time of CasADi with IPOPT, by that of the generated solver")
        figure.legend(loc="outside lower center", ncols=2)
        titled(figure, f"CasADi with IPOPT takes {ratio()}")
    return figure


def reports() -> Iterator[str]:
    """Of each problem with a report: errors against steps and run time, and the orders that were measured."""
    for path in sorted(MEASURED.glob("report_*.json")):
        record = read(path.stem)
        yield f"### `{record['problem']}`\n"
        yield picture(path.stem, work_precision(record))
        if record["orders"]:
            cells = [f"{own['case']} {own['order']:.2f} ({own['stated order']})" for own in record["orders"]]
            yield f"Measured orders, the stated ones in brackets: {', '.join(cells)}.\n"
        few = " The report was a quick one." if record["quick"] else ""
        yield f"{said(record)}{few} `codegen report problems/{record['problem']}.py --out DIR` measures it.\n"


def work_precision(record: dict[str, Any]) -> Figure:
    """Error against the number of steps, and against the time of a solve."""
    lines: dict[str, list[tuple[float, float, float]]] = {}
    for case in record["cases"]:
        name, _, steps = case["case"].rpartition("; N ")
        if case["status"] == "solved" and steps.split(";")[0].isdigit():
            own = (float(steps.split(";")[0]), float(case["seconds"]), float(case["error"]))
            lines.setdefault(name, []).append(own)
    what = record["cases"][0]["error of"]
    with using("page"):
        figure = Figure(figsize=(11.0, 4.6), layout="constrained")
        left, right = figure.subplots(1, 2, sharey=True)
        for number, (name, rows) in enumerate(lines.items()):
            steps, seconds, errors = zip(*sorted(rows), strict=True)
            look: dict[str, Any] = {
                "color": _COLOURS[number % len(_COLOURS)], "marker": ".", "label": name,
                "linestyle": _DASHES[number // len(_COLOURS) % len(_DASHES)],
            }  # fmt: skip
            left.loglog(steps, errors, **look)
            right.loglog([1e3 * own for own in seconds], errors, **look)
        left.set_xlabel("steps")
        left.set_ylabel(f"relative error of the {what}")
        right.set_xlabel("milliseconds of a warm solve")
        figure.legend(*left.get_legend_handles_labels(), loc="outside lower center", ncols=4)
        titled(figure, f"{record['problem']}: error of the {what} against steps and run time")
    return figure


def robustness() -> str:
    """How often both solvers solve cases from guesses with noise: shares of all, and a picture of those that differ."""
    record = read("robustness")
    rows = []
    for collection in dict.fromkeys(case["collection"] for case in record["cases"]):
        cases = [case["solvers"] for case in record["cases"] if case["collection"] == collection]
        guesses = sum(case["generated"]["guesses"] for case in cases)
        for solver, name in (("generated", _OURS), ("IPOPT", _THEIRS)):
            solved, best = (mean([case[solver][key] for case in cases]) for key in ("solved", "best"))
            false = sum(case[solver]["false"] for case in cases)
            rows.append(f"| {collection} | {len(cases)} | {guesses} | {name} | {solved:.1%} | {best:.1%} | {false} |")
    head = "| set | cases | guesses | solver | solved | with the least cost | false claims |\n" + "|---" * 7 + "|"
    return "\n".join([head, *rows, "", picture("robustness", robustness_figure(record)), said(record)])


def mean(shares: Sequence[float]) -> float:
    """The mean of some shares."""
    return sum(shares) / len(shares)


def robustness_figure(record: dict[str, Any]) -> Figure:
    """Shares of guesses that are solved, where one of the two does not solve all."""
    differ = [case for case in record["cases"] if any(own["solved"] < 1.0 for own in case["solvers"].values())]
    differ.sort(key=lambda case: (case["solvers"]["IPOPT"]["solved"], case["solvers"]["generated"]["solved"]))
    with using("page"):
        figure = Figure(figsize=(9.0, 0.27 * len(differ) + 1.3), layout="constrained")
        axes = figure.add_subplot()
        for solver, name, colour in (("IPOPT", _THEIRS, AMBER), ("generated", _OURS, BLUE)):
            shares = [100.0 * case["solvers"][solver]["solved"] for case in differ]
            axes.plot(shares, range(len(differ)), "o", color=colour, markersize=6, label=name)
        axes.set_yticks(range(len(differ)), [f"{case['problem']}, N = {case['steps']}" for case in differ], fontsize=8)
        axes.set_xlim(-3.0, 103.0)
        axes.set_xlabel("% of guesses that are solved")
        figure.legend(loc="outside lower center", ncols=2)
        titled(figure, f"Cases that one of both does not always solve, {len(differ)} of {len(record['cases'])}")
    return figure


def stress() -> str:
    """How many cases of each family of stiff and extreme cases ended how."""
    record = read("stress")
    outcomes = list(dict.fromkeys(own["outcome"] for own in record["counts"]))
    families = dict.fromkeys(own["family"] for own in record["counts"])
    counts = {(own["family"], own["outcome"]): own["cases"] for own in record["counts"]}
    rows = [f"| {family} | {' | '.join(str(counts.get((family, o), '')) for o in outcomes)} |" for family in families]
    total = [str(sum(counts.get((family, outcome), 0) for family in families)) for outcome in outcomes]
    head = [f"| family | {' | '.join(outcomes)} |", "|---|" + "---|" * len(outcomes)]
    few = " These are the cases of `--quick`." if sum(map(int, total)) < _ALL_STRESS else ""
    return "\n".join([*head, *rows, f"| all | {' | '.join(total)} |", "", said(record) + few])
