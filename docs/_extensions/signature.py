"""The directive `signature`: the call of a name of the package, and its docstring, whose sections become lists."""

from __future__ import annotations

import ast
import inspect
from functools import reduce
from importlib import import_module
from itertools import pairwise
from typing import Any

from docutils import nodes
from docutils.statemachine import StringList
from sphinx import addnodes
from sphinx.util.docutils import SphinxDirective

import codegen


def found(name: str) -> Any:
    """The object of a dotted name in `codegen`, or in a module of it, as in `solving.results.result:Result`."""
    module, _, own = name.rpartition(":")
    return reduce(getattr, own.split("."), import_module(f"codegen.{module}" if module else "codegen"))


def is_alias(thing: Any) -> bool:
    """Whether a name stands for a type with a mark, whose own docstring is that of `Annotated`."""
    return hasattr(thing, "__metadata__")


def text(name: str) -> str:
    """The docstring, which of an alias is the text below its definition."""
    thing = found(name)
    if not is_alias(thing):
        return inspect.getdoc(thing) or ""
    body = ast.parse(inspect.getsource(import_module(codegen._MODULES[name]))).body
    below = [
        after.value.value
        for before, after in pairwise(body)
        if isinstance(before, ast.AnnAssign) and ast.unparse(before.target) == name
        if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
    ]
    return str(below[0]) if below else ""


def markdown(docstring: str) -> list[str]:
    """Return a docstring as Markdown: a section of numpydoc becomes a bold heading and a list of its entries."""
    lines, written, section = docstring.splitlines(), list[str](), ""
    for number, line in enumerate(lines):
        following = lines[number + 1] if number + 1 < len(lines) else ""
        if line and set(line) == {"-"}:
            continue
        if line and following and set(following) == {"-"}:
            section = line
            written += [f"**{line}**", ""]
        elif section not in ("", "Notes") and line and not line.startswith(" "):
            entry, _, kind = line.partition(" : ")
            is_named = kind or section in ("Parameters", "Attributes")
            names = ", ".join(f"`{each}`" for each in entry.split(", ")) if is_named else entry
            written.append(f"- {names}{f' ({kind})' if kind else ''}{':' * following.startswith(' ')}")
        else:
            written.append(f"  {line.strip()}" if section not in ("", "Notes") and line else line)
    return written


def call(name: str) -> str:
    """The call on as many lines as it needs, with annotations."""
    thing = found(name)
    own = name.rpartition(":")[2]
    if is_alias(thing):
        return f"{own} = {str(thing).removeprefix('typing.').replace('pathlib.', '')}"
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


def page_of(name: str) -> str:
    """Return the file name of the page that has the full docstring of a name.

    Files of classes are marked: some file systems take `Control` and `control` for one name.
    """
    own = name.rpartition(":")[2].partition(".")[0].replace("Display", "Result")
    return f"{own}-class" if own[0].isupper() else own


class Signature(SphinxDirective):
    """The signature in code, and the first paragraph of the docstring with a link to the page of the object.

    With `full` the directive shows the whole docstring, and enters the name in the index and in the list of objects.
    """

    required_arguments = 1
    option_spec = {"full": lambda _: True}  # noqa: RUF012  docutils's own way

    def run(self) -> list[nodes.Node]:
        """Parse the docstring where the directive stands."""
        name = self.arguments[0]
        block, docstring = nodes.literal_block("", call(name), language="python"), text(name)
        shown = nodes.container()
        if "full" in self.options:
            self.state.nested_parse(StringList(markdown(docstring), source=name), 0, shown)
            return [*self._entered(name), block, *shown.children]
        lines = [
            *docstring.partition("\n\n")[0].splitlines(),
            "",
            f"[Parameters and details](objects/{page_of(name)}.md)",
        ]
        self.state.nested_parse(StringList(lines, source=name), 0, shown)
        return [block, *shown.children]

    def _entered(self, name: str) -> list[nodes.Node]:
        """Enter a name in the index, in the search and in `objects.inv`; return the target and its entry."""
        own = name.rpartition(":")[2].replace("Display.", "Result.")
        thing = found(name)
        kind = "method" if "." in own else "type" if is_alias(thing) else "function"
        if inspect.isclass(thing):
            kind = "exception" if issubclass(thing, Exception) else "class"
        node_id = nodes.make_id(f"codegen.{own}")
        self.env.get_domain("py").note_object(f"codegen.{own}", kind, node_id, location=self.get_location())
        entry = addnodes.index(entries=[("single", f"{own} ({kind})", node_id, "", None)])
        return [nodes.target("", "", ids=[node_id]), entry]


def setup(app: Any) -> dict[str, bool]:
    """Register the directive."""
    app.add_directive("signature", Signature)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
