"""The open questions of chapter 6 of the thesis, each answered by measurements."""

from __future__ import annotations

from collections.abc import Sequence

from codegen.evidence.report import landmark_effort, landmark_figures, landmark_motion
from codegen.evidence.report.landmark_motion import LOOSE, TIGHT, Minimisation
from codegen.evidence.report.page import Picture, Section, Table, listed, number, seconds, slope, svg
from codegen.evidence.report.store import Settings, Store

_THESIS = Minimisation("nodes", "curved", LOOSE)  # the variant of the minimisation that the thesis uses
_JUMP = 5.0  # a jump is a growth of the error by this factor from one N to the next, while the iterations decrease


def question_sections(settings: Settings, store: Store) -> list[Section]:
    """Return the sections on the questions of chapter 6, then on the check of appendix B.2."""
    return [
        _paths(settings, store), _dimension(store), _smoothness(store), _jumps(settings, store),
        _midpoint(settings, store), _orders(store), _ansatz(store),
    ]  # fmt: skip


def _paths(settings: Settings, store: Store) -> Section:
    sets = [f"nc {n}" for n in (*settings.counts, 40)] + ["nc 100, smooth"]
    rows, texts = [], []
    for kind, meaning in landmark_motion.KINDS.items():
        cells, distances = [], []
        for name in sets:
            values = store.get(landmark_motion.PATHS_SECTION, f"{kind}; {name}")
            if values is None:
                cells.append("–")
                continue
            cells.append(f"{values['iterations']}" if values["solved"] else f"fails ({values['iterations']})")
            if values["distance of places"] is not None:
                distances.append(values["distance of places"])
        rows.append((meaning, *cells, number(max(distances, default=None), 2)))
    for name in sets:
        by_kind = {kind: store.get(landmark_motion.PATHS_SECTION, f"{kind}; {name}") for kind in landmark_motion.KINDS}
        solved = {kind: v["iterations"] for kind, v in by_kind.items() if v is not None and v["solved"]}
        failed = [kind for kind, v in by_kind.items() if v is not None and not v["solved"]]
        if not solved:
            texts.append(f"{name}: no guess leads to a solution.")
            continue
        least, curved = min(solved.values()), solved.get("curved")
        best = listed([kind for kind, iterations in solved.items() if iterations == least])
        comparison = "the curved path fails"
        if curved is not None:
            comparison = "the curved path needs as few" if curved == least else f"the curved path needs {curved}"
        failures = f"; from {listed(failed)} there is no convergence." if failed else "."
        texts.append(f"{name}: fewest iterations, {least}, from {best}; {comparison}{failures}")
    table = Table(
        f"Iterations of Newton's method for all states at once, explicit Euler, N = {landmark_motion.PATHS_STEPS}, and "
        "how far the guessed places are from the solution at most.",
        ("initial path", *sets, "distance"),
        tuple(rows),
    )
    return Section("Question 1: can better initial paths be generated?", tuple(texts), (table,))


def _dimension(store: Store) -> Section:
    lines, texts, rows = landmark_figures.by_kernel(store), [], []
    for name, line in lines.items():
        large = [(n, v) for n, v in line if n >= 20]
        exponents = [
            slope([n for n, _ in large], [v[key] for _, v in large]) for key in ("seconds of a trajectory", "seconds")
        ]
        count, last = line[-1]
        rows.append((
            name, str(last["operations"][1]), str(count), seconds(last["seconds of a trajectory"]),
            seconds(last["seconds"]), *(number(exponent, 2) for exponent in exponents),
        ))  # fmt: skip
    for kernel in ("gauss", "plate"):
        pair = [lines[name] for name in (f"{kernel} 2-D", f"{kernel} 3-D") if name in lines]
        if len(pair) == 2:
            count = min(line[-1][0] for line in pair)
            times = [dict(line)[count]["seconds of a trajectory"] for line in pair]
            texts.append(
                f"{kernel}: {count} landmarks in space take {number(times[1] / times[0], 2)} times as long "
                "for a trajectory as in the plane."
            )
    texts.append(
        "The dimension changes the operations of each pair only, whose numbers the table gives; logarithms and roots "
        "among them count as one each, though they take longer. Growth with the number of landmarks is measured below."
    )
    table = Table(
        "Growth with the number of landmarks: exponents from 20 landmarks on; operations for each pair as emitted.",
        ("kernel", "operations", "landmarks", "trajectory", "solve", "exponent, trajectory", "exponent, solve"),
        tuple(rows),
    )
    picture = Picture(
        "Processor time of a trajectory and of a solve, explicit Euler, N = 10.",
        svg(landmark_figures.dimension_figure, store),
    )
    title = "Question 2: how do the methods scale with the dimension of space?"
    return Section(title, tuple(texts), (table,), (picture,))


def _smoothness(store: Store) -> Section:
    texts, rows = [], []
    for amplitude in landmark_motion.AMPLITUDES:
        warps = landmark_figures.warps(store, amplitude)
        if not warps:
            texts.append(f"Displacements × {amplitude:g}: too few of the warps were solved.")
            continue
        fine = [v for v in warps if v["steps"] >= 5]
        order = -slope([v["steps"] for v in fine], [v["error"] for v in fine])
        steps = [next((v["steps"] for v in warps if v["error"] <= limit), None) for limit in (1e-2, 1e-3)]
        folded = [str(v["steps"]) for v in warps if v["least area"] <= 0.0]
        rows.append((
            f"× {amplitude:g}", number(warps[0]["exact least area"], 3),
            *("> 80" if n is None else str(n) for n in steps), listed(folded),
            number(warps[-1]["steepest"] * warps[-1]["steps"], 3), number(order, 2),
        ))  # fmt: skip
        if folded and len(folded) < len(warps):
            texts.append(f"Displacements × {amplitude:g} fold the grid with N = {listed(folded)}.")
    if rows:
        needs = "; ".join(f"{row[0]} need N = {row[2]} for an error of 1e-2 and {row[3]} for 1e-3" for row in rows)
        folds = "No warp folds." if all(row[4] == "none" for row in rows) else "Some warps fold."
        texts.append(f"Displacements {needs}. {folds}")
    texts.append(
        "A single explicit step is one to one where h times the Lipschitz constant of v is below one; the constant "
        "that was measured tells how many steps guarantee it."
    )
    table = Table(
        "The trilobites' landmarks with displacements multiplied, explicit Euler; the warp of a grid of the disc "
        "against that with 640 steps.",
        ("displacements", "least area, exact", "N for error 1e-2", "N for error 1e-3", "N that fold",
         "Lipschitz constant", "order"),
        tuple(rows),
    )  # fmt: skip
    picture = Picture(
        "Error of the warp, and the least ratio by which areas change (dotted: with 640 steps); below zero there is "
        "a fold.",
        svg(landmark_figures.smoothness_figure, store),
    )
    title = "Question 3: how many steps does a warp of given smoothness need?"
    return Section(title, tuple(texts), (table,), (picture,))


def _jumps(settings: Settings, store: Store) -> Section:
    texts, rows = [], []
    for count in settings.counts[:2]:
        null = store.get(landmark_motion.JUMPS_SECTION, f"null space; nc {count}")
        if null is not None:
            texts.append(
                f"nc = {count}: with momenta on nodes, {null['nodes']} directions of the unknowns change neither the "
                f"cost nor a constraint; with momenta on intervals, {null['intervals']}."
            )
        by_variant = {
            variant: line
            for variant in landmark_motion.VARIANTS
            if (line := landmark_figures.by_variant(settings, store, variant, count))
        }
        for variant, line in by_variant.items():
            errors = [v["error"] for _, v in line]
            rows.append((
                f"nc {count}, {variant.momenta}, {variant.path}, {variant.tolerance:.0e}", str(line[-1][0]),
                number(min(errors), 2), number(max(errors), 2), number(max(v["constraints"] for _, v in line), 2),
                number(max(v["stationarity"] for _, v in line), 2), _range([v["iterations"] for _, v in line], "–"),
                number(max(v["alternating"] for _, v in line), 2),
            ))  # fmt: skip
        texts += _conclusions(count, by_variant)
    table = Table(
        "Midpoint rule as a minimisation by SLSQP: error of its cost against Newton's minimum of the same discrete "
        "problem, largest residuals where it stopped, iterations, and the largest alternating part of nodal momenta.",
        ("variant", "N up to", "least error", "largest error", "constraints", "stationarity", "iterations",
         "alternating part"),
        tuple(rows),
    )  # fmt: skip
    picture = Picture(
        "Error and time of SLSQP: red with momenta on nodes as in the thesis, blue on intervals; full lines from "
        "curved and dotted ones from straight paths at tolerance 1e-6, dashes at 1e-14.",
        svg(landmark_figures.jump_figure, settings, store),
    )
    title = "Question 4: what happens inside the optimiser in Figures 5.8 and 5.9?"
    return Section(title, tuple(texts), (table,), (picture,))


def _conclusions(count: int, by_variant: dict[Minimisation, landmark_figures.Rows]) -> list[str]:
    """Return conclusions on tolerances, momenta and initial paths, for the set of `count` landmarks."""
    worst = {variant: max(v["error"] for _, v in line) for variant, line in by_variant.items()}
    loose = max((error for variant, error in worst.items() if variant.tolerance == LOOSE), default=None)
    tight = max((error for variant, error in worst.items() if variant.tolerance == TIGHT), default=None)
    if loose is None or tight is None:
        return []
    texts = []
    if loose > 100.0 * tight:
        texts.append(
            f"nc = {count}: at tolerance 1e-6 the optimiser stops early, up to {number(loose, 2)} from the "
            f"minimum; at 1e-14 within {number(tight, 2)}: errors of this kind come from the tolerance."
        )
    else:
        texts.append(
            f"nc = {count}: the tolerance does not decide: errors are up to {number(loose, 2)} at 1e-6 and up to "
            f"{number(tight, 2)} at 1e-14."
        )
    with_jumps, without, early = [], [], list[int]()
    for variant, line in by_variant.items():
        name = f"momenta on {variant.momenta}, {variant.path} paths, {variant.tolerance:g}"
        jumps = [
            (n, v["iterations"])
            for (n, v), (_, before) in zip(line[1:], line[:-1], strict=True)
            if v["error"] > _JUMP * max(before["error"], 1e-12) and v["iterations"] < before["iterations"]
        ]
        if variant == _THESIS:
            early = [iterations for _, iterations in jumps]
        if jumps:
            with_jumps.append(f"{name} at N = {listed([str(n) for n, _ in jumps])}")
        else:
            without.append(name)
    outcome = "are reproduced" if early else "are not reproduced as far as N went"
    texts.append(
        f"nc = {count}: the thesis's jumps to faster and less accurate solves {outcome}. The error grows by a factor "
        f"of {_JUMP:g} or more from one N to the next as iterations fall: {'; '.join(with_jumps) or 'nowhere'}. "
        f"No such jump: {'; '.join(without) or 'nowhere'}."
    )
    if early:
        texts.append(
            f"At these N the optimiser, started from the curved paths, is content after {_range(early, ' to ')} "
            "iterations, because the cost then changes by less than the tolerance though it is not stationary."
        )
    return texts


def _range(numbers: Sequence[int], separator: str) -> str:
    least, largest = min(numbers), max(numbers)
    return f"{least}" if least == largest else f"{least}{separator}{largest}"


def _midpoint(settings: Settings, store: Store) -> Section:
    texts, rows = [], []
    for count in (*settings.counts, 40):
        generated = store.get(landmark_effort.MIDPOINT_SECTION, f"generated; nc {count}")
        nested = store.get(landmark_effort.MIDPOINT_SECTION, f"nested fsolve; nc {count}")
        if generated is None:
            continue
        ratio = generated["midpoint seconds"] / generated["explicit-euler seconds"]
        rows.append((
            str(count), seconds(generated["midpoint seconds"]), seconds(generated["explicit-euler seconds"]),
            number(ratio, 2), number(generated["midpoint trajectory"] / generated["explicit-euler trajectory"], 2),
            seconds(nested["seconds"]) if nested else "–",
            number(nested["seconds"] / generated["midpoint seconds"] if nested else None, 2),
        ))  # fmt: skip
        if count == 40:
            thesis = landmark_effort.THESIS_TABLE["midpoint"][0] / landmark_effort.THESIS_TABLE["explicit-euler"][0]
            texts.append(
                f"Forty landmarks, N = 10: midpoint stepping takes {number(ratio, 2)} times as long as explicit Euler, "
                f"{'less' if ratio < thesis else 'more'} than the thesis's {number(thesis, 3)}."
            )
    table = Table(
        "Processor time of midpoint stepping, N = 10: Newton's method with generated derivatives inside each step and "
        "for the initial momenta, beside root finders with differences inside root finders.",
        ("nc", "midpoint", "explicit Euler", "ratio", "ratio of trajectories", "nested fsolve, as in the thesis",
         "its time / ours"),
        tuple(rows),
    )  # fmt: skip
    return Section("Question 5: can midpoint stepping be made efficient?", tuple(texts), (table,))


def _orders(store: Store) -> Section:
    exact = landmark_figures.reference_cost(store, 40)
    rows = []
    for scheme in landmark_effort.SCHEMES:
        runs = [
            v for name, v in store.rows(landmark_effort.WORK)
            if name.startswith(f"{scheme};") and v["status"] == "solved"
        ]  # fmt: skip
        if not runs:
            continue
        errors = [abs(v["cost"] - exact) for v in runs]
        points = [(v["steps"], error) for v, error in zip(runs, errors, strict=True) if error > 1e-11]
        order = -slope([n for n, _ in points], [error for _, error in points])
        cells = [f"{number(error, 2)} in {seconds(v['seconds'])}" for v, error in zip(runs, errors, strict=True)]
        rows.append((scheme, *cells, number(order, 2)))
    most = max((len(row) for row in rows), default=2)
    padded = tuple((*row[:-1], *["–"] * (most - len(row)), row[-1]) for row in rows)
    head = ("scheme", *(f"N = {n}" for n in (5, 10, 20, 40, 80)[: most - 2]), "order")
    table = Table("Error in cost and seconds on forty landmarks, compiled.", head, padded)
    picture = Picture(
        "Error against time on forty landmarks; crosses: adaptive codes of scipy at the tolerances of the sweep.",
        svg(landmark_figures.work_and_precision, store),
    )
    # The fastest scheme for each error, compared with explicit Euler, midpoint and DOP853.
    texts, columns = [], []
    schemes = (*landmark_effort.STEPPED, *landmark_effort.ADAPTIVE)
    for target in landmark_effort.TARGETS:
        results = {s: store.get(landmark_effort.FASTEST_SECTION, f"{s}; {target:g}") for s in schemes}
        reached = {scheme: v for scheme, v in results.items() if v is not None and v["reached"]}
        columns.append({s: f"{v['steps']} in {seconds(v['seconds'])}" for s, v in reached.items()})
        if not reached:
            continue
        best = min(reached, key=lambda scheme: reached[scheme]["seconds"])
        time, comparisons = reached[best]["seconds"], []
        for scheme in ("explicit-euler", "midpoint", "dop853"):
            if scheme not in reached:
                comparisons.append(f"{scheme} does not get there")
            elif scheme != best:
                comparisons.append(f"{scheme} takes {number(reached[scheme]['seconds'] / time, 2)} times as long")
        texts.append(
            f"Error below {target:g}: {best} with {reached[best]['steps']} steps, in {seconds(time)}; "
            f"{listed(comparisons)}."
        )
    fastest = Table(
        "Fewest steps, or loosest tolerance of four a decade, that meet an error in cost on forty landmarks, and wall-"
        "clock time; a dash where 3000 steps do not suffice.",
        ("scheme", *(f"{target:g}" for target in landmark_effort.TARGETS)),
        tuple((s, *(column.get(s, "–") for column in columns)) for s in schemes),
    )
    return Section("Question 6: do higher orders pay, compiled?", tuple(texts), (fastest, table), (picture,))


def _ansatz(store: Store) -> Section:
    measured = list(store.rows(landmark_effort.WEAK_SOLUTION_SECTION))
    rows = [(name, number(v["largest defect"], 2), number(v["largest rate"], 2)) for name, v in measured]
    worst = max((v["largest defect"] / v["largest rate"] for _, v in measured), default=1.0)
    word = "vanishes up to the error of the differences" if worst < 1e-6 else "does NOT vanish"
    text = (
        f"The left side of the weak equation {word}: at most {number(worst, 2)} of its first term. That it vanishes "
        "for every kernel and every test function is proved by computer algebra (tests/evidence/test_weak_solution.py)."
    )
    table = Table(
        "Fifteen random test functions along the motion: the largest left side, and the largest first term alone.",
        ("landmarks", "left side", "first term"),
        tuple(rows),
    )
    return Section("The particle ansatz as a weak solution (B.2)", (text,), (table,))
