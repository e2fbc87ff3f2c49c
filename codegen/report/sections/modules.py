"""Sections about the modules themselves: sizes, and times of making them."""

from __future__ import annotations

from collections.abc import Sequence

from codegen.report.building import MODULES, Variant
from codegen.report.section import Section, Table, listed, number
from codegen.report.store import Store


def modules(store: Store, variants: Sequence[Variant], title: str, left: Sequence[str] = ()) -> Section:
    """Times and sizes of every module, operations of its kernels, and refusals."""
    rows, refused = [], []
    for variant in variants:
        values = store.get(MODULES, variant.case)
        if values is None:
            continue
        if values["status"] != "built":
            refused.append(f"{variant.label} ({values['message']})")
            continue
        before, after = (sum(pair[i] for pair in values["operations"].values()) for i in (0, 1))
        rows.append((
            variant.label, number(values["derivation seconds"]),
            number(values.get("compile processor seconds")), number(values["load seconds"]),
            str(values["lines"]), str(values["kernel lines"]), f"{values['bytes'] / 1024:.1f}",
            f"{before} → {after}", str(len(values["left out"])),
        ))  # fmt: skip
    head = ("module", "derive [s]", "compile [s]", "load [s]", "lines", "of these kernels", "KiB",
            "operations, before → after sharing", "parts left out")  # fmt: skip
    texts = []
    if refused:
        texts.append("Schemes that do not apply: " + "; ".join(refused) + ".")
    if left:
        texts.append(f"Not measured, to keep the report short: {_by_method(left)}.")
    table = Table(
        "Modules. Operations are those of one evaluation of every kernel. Two modules are made at a time, and what "
        "the build cache holds is not derived again; compiling is processor time.", head, tuple(rows),
    )  # fmt: skip
    return Section(title, tuple(texts), (table,) if rows else ())


def _by_method(labels: Sequence[str]) -> str:
    """Schemes after the name of their method."""
    groups: dict[str, list[str]] = {}
    for label in labels:
        method, scheme = label.split(" ", 1)
        groups.setdefault(method, []).append(scheme)
    return "; ".join(f"{method} {listed(schemes)}" for method, schemes in groups.items())
