"""The directive `signature`: how a name of the package is called, and its docstring, which is Markdown already."""

from __future__ import annotations

import inspect
import re
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
    whole = str(signature.replace(parameters=parameters))
    whole = re.sub(r"'([^']*)'", r"\1", whole) if "'" in whole and '"' not in whole else whole
    line = f"{own}{whole}"
    if len(line) <= 88:
        return line
    written, kinds = [], set()
    for each in parameters:
        if each.kind is each.KEYWORD_ONLY and not kinds & {each.KEYWORD_ONLY, each.VAR_POSITIONAL}:
            written.append("*")
        kinds.add(each.kind)
        written.append(str(each).replace("'", ""))
    returned = "" if signature.return_annotation is signature.empty else f" -> {signature.return_annotation}"
    return f"{own}(\n" + "".join(f"    {each},\n" for each in written) + ")" + str(returned).replace("'", "")


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
