"""The directive `signature`: how a name of the package is called, and its docstring, which is Markdown already."""

from __future__ import annotations

import inspect
from functools import reduce
from importlib import import_module
from typing import Any

from docutils import nodes
from docutils.statemachine import StringList
from sphinx.util.docutils import SphinxDirective


def found(name: str) -> Any:
    """The object of a dotted name in `codegen`, or in a module of it, as in `solutions.result:Result`."""
    module, _, own = name.rpartition(":")
    return reduce(getattr, own.split("."), import_module(f"codegen.{module}" if module else "codegen"))


def call(name: str) -> str:
    """The call on as many lines as it needs, with annotations."""
    thing = found(name)
    own = name.rpartition(":")[2]
    try:
        signature = inspect.signature(thing)
    except (TypeError, ValueError):
        return own
    parameters = [each for each in signature.parameters.values() if each.name != "self"]
    written = []
    for before, each in zip([None, *parameters], parameters):
        is_first = each.kind is each.KEYWORD_ONLY and (before is None or before.kind is each.POSITIONAL_OR_KEYWORD)
        written += ["*", one(each)] if is_first else [one(each)]
    returned = signature.return_annotation
    tail = "" if returned in (signature.empty, "None", None) else f" -> {annotation(returned)}"
    line = f"{own}({', '.join(written)}){tail}"
    return line if len(line) <= 88 else f"{own}(\n" + "".join(f"    {each},\n" for each in written) + f"){tail}"


def one(parameter: inspect.Parameter) -> str:
    """A parameter with its annotation and default, as in code."""
    mark = {parameter.VAR_POSITIONAL: "*", parameter.VAR_KEYWORD: "**"}.get(parameter.kind, "")
    told = "" if parameter.annotation is parameter.empty else f": {annotation(parameter.annotation)}"
    if parameter.default is parameter.empty:
        return f"{mark}{parameter.name}{told}"
    default = "..." if "factory" in repr(parameter.default) else repr(parameter.default)
    return f"{mark}{parameter.name}{told} = {default}"


def annotation(written: Any) -> str:
    """An annotation, which is text already where modules postpone them."""
    return written if isinstance(written, str) else getattr(written, "__name__", str(written))


class Signature(SphinxDirective):
    """The signature in code, and the docstring as Markdown; `no-text` leaves the latter out."""

    required_arguments = 1
    option_spec = {"no-text": lambda _: True}  # noqa: RUF012  docutils's own way

    def run(self) -> list[nodes.Node]:
        """Parse the docstring where the directive stands."""
        name = self.arguments[0]
        block = nodes.literal_block("", call(name), language="python")
        text = nodes.container()
        if "no-text" not in self.options:
            lines = (inspect.getdoc(found(name)) or "").splitlines()
            self.state.nested_parse(StringList(lines, source=name), 0, text)
        return [block, *text.children]


def setup(app: Any) -> dict[str, bool]:
    """Register the directive."""
    app.add_directive("signature", Signature)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
