"""Count words per sentence, openings and words to avoid on the pages of the documentation.

    python docs/prose.py                     a row for each page
    python docs/prose.py docs/start.md ...   these pages, with every sentence that breaks a rule

Code, tables, headings and formulas are left out. `tests/test_prose.py` holds every page to the limits below.
"""

from __future__ import annotations

import re
import sys
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
MEAN_LIMIT = 18
"""The mean number of words per sentence of a page is below this number."""
LONGEST_LIMIT = 30
"""No sentence has more words than this number."""
OPENINGS = ("What", "Whether", "How", "Where", "Which", "Why")
"""First words of statements that put an indirect question in front. Real questions may begin with these words."""
AVOIDED = (
    "beside", "says so", "said so", "as a whole", "there is none", "in parts of", "off by", "what is left of",
    "what a search begins from", "what no node owns", "what is given at", "told", "verdict", "as found",
)  # fmt: skip
"""Phrases that always have a plainer form. No page contains one of them."""
AMBIGUOUS = (
    "weight", "border", "shared unknowns", "sizes", "course", "damping", "judgement", "conditions at inner times",
    "place", "span", "other values", "touch", "engine", "team", "here", "pace", "flat", "idle", "known", "below",
    "notable", "statement",
)  # fmt: skip
"""Words that the glossary replaces in one of their meanings. The script counts them, the test allows them."""

_FENCE = re.compile(r"^(?P<indent> *)(?P<fence>```+|~~~+).*?^(?P=indent)(?P=fence)`*~* *$", re.MULTILINE | re.DOTALL)
_FRONT_MATTER = re.compile(r"\A---\n.*?^---$", re.MULTILINE | re.DOTALL)
_COMMENT = re.compile(r"<!--.*?-->", re.DOTALL)
_FORMULA = re.compile(r"\$\$.*?\$\$", re.DOTALL)
_INLINE_FORMULA = re.compile(r"\$[^$\n]+(?:\n[^$\n]+)?\$")
_ROLE = re.compile(r"\{[\w:-]+\}`+[^`]*`+")
_CODE = re.compile(r"(`+)[^`].*?\1", re.DOTALL)
_IMAGE = re.compile(r"!\[[^\]]*\]\([^)]*\)")
_LINK = re.compile(r"\[([^\]]*)\]\([^)]*\)")
_LABEL = re.compile(r"^\([\w-]+\)=$")
_ITEM = re.compile(r"^\s*(?:[-*+]|\d+[.)])\s+|^:\s+")
_END = re.compile(
    r"(?<!\be\.g)(?<!\bi\.e)(?<!\bcf)(?<!\bvs)(?<!\bal)(?<![ (][A-Z])[.!?][\"')*_]*\s+(?=[\"'(*_]*[A-Z0-9`@])"
)
_WORD = re.compile(r"[\w'’.,/+^=<>|°%-]*\w[\w'’.,/+^=<>|°%-]*")


@dataclass(frozen=True)
class Prose:
    """The sentences of a page.

    Attributes
    ----------
    sentences : tuple of str
        Sentences in the order of the page. Inline code and formulas are replaced by ``CODE`` and ``FORMULA``.
    """

    sentences: tuple[str, ...]

    @property
    def lengths(self) -> list[int]:
        """Return the number of words of each sentence."""
        return [len(words(sentence)) for sentence in self.sentences]

    @property
    def mean(self) -> float:
        """Return the mean number of words per sentence, 0 for a page without sentences."""
        return sum(self.lengths) / max(1, len(self.sentences))

    @property
    def longest(self) -> int:
        """Return the number of words of the longest sentence, 0 for a page without sentences."""
        return max(self.lengths, default=0)

    def too_long(self) -> list[str]:
        """Return the sentences with more than `LONGEST_LIMIT` words."""
        return [sentence for sentence, length in zip(self.sentences, self.lengths) if length > LONGEST_LIMIT]

    def indirect(self) -> list[str]:
        """Return the statements that begin with a word of `OPENINGS`."""
        return [each for each in self.sentences if each.startswith(OPENINGS) and not each.rstrip('")*_').endswith("?")]

    def containing(self, phrases: tuple[str, ...]) -> Counter[str]:
        """Return the number of occurrences of each phrase that occurs.

        Parameters
        ----------
        phrases : tuple of str
            Phrases in lower case. A phrase occurs as whole words, in any case.
        """
        text = "\n".join(self.sentences).lower()
        counts = {phrase: len(re.findall(rf"\b{re.escape(phrase)}\b", text)) for phrase in phrases}
        return Counter({phrase: count for phrase, count in counts.items() if count})


def words(sentence: str) -> list[str]:
    """Return the words of a sentence.

    Parameters
    ----------
    sentence : str
        A sentence of `Prose.sentences`.

    Examples
    --------
    >>> words("The cost is 432.96, see Table 2.")
    ['The', 'cost', 'is', '432.96,', 'see', 'Table', '2.']
    """
    return _WORD.findall(sentence)


def prose_of(text: str) -> Prose:
    """Return the sentences of a page in Markdown.

    A sentence ends at a full stop, question mark or exclamation mark that precedes a capital letter, a digit or code.
    The end of a paragraph or of an item of a list ends a sentence, too.

    Parameters
    ----------
    text : str
        The text of the page.

    Examples
    --------
    >>> prose_of("# Title\\n\\nOne sentence. Another one, with `code`.\\n\\n- an item\\n").sentences
    ('One sentence.', 'Another one, with CODE.', 'an item')
    """
    for pattern, replacement in (
        (_FRONT_MATTER, ""),
        (_FENCE, "\n"),
        (_COMMENT, ""),
        (_FORMULA, " FORMULA "),
        (_ROLE, "CODE"),
        (_CODE, "CODE"),
        (_INLINE_FORMULA, "FORMULA"),
        (_IMAGE, ""),
        (_LINK, r"\1"),
    ):
        text = pattern.sub(replacement, text)
    blocks: list[list[str]] = [[]]
    in_list = False
    for line in text.splitlines():
        is_item = bool(_ITEM.match(line))
        is_code = line.startswith("    ") and not in_list
        if not line.strip() or is_code or line.lstrip().startswith(("|", "#", ":::", "---")) or _LABEL.match(line):
            blocks.append([])
        elif is_item:
            blocks.append([_ITEM.sub("", line)])
        else:
            blocks[-1].append(line.strip())
        in_list = is_item or (in_list and (not line.strip() or line.startswith(" ")))
    paragraphs = (" ".join(block).strip() for block in blocks)
    found = (part.strip() for paragraph in paragraphs for part in _split(paragraph))
    return Prose(tuple(sentence for sentence in found if words(sentence)))


def _split(paragraph: str) -> list[str]:
    """Return the sentences of a paragraph, each with its full stop."""
    ends = [match.end() for match in _END.finditer(paragraph)]
    return [paragraph[start:end] for start, end in zip([0, *ends], [*ends, len(paragraph)])]


def pages() -> list[Path]:
    """Return the files with prose: three of the root folder, and all of `docs/` that no build writes."""
    ignored = (ROOT / ".gitignore").read_text(encoding="utf-8").split()
    made = {path for pattern in ignored if pattern.startswith("docs/") for path in ROOT.glob(pattern)}
    in_docs = [*(ROOT / "docs").rglob("*.md"), *(ROOT / "docs").rglob("*.in")]
    kept = (path for path in in_docs if "_build" not in path.parts and path not in made)
    return [*(ROOT / name for name in ("README.md", "CHANGELOG.md", "CONTRIBUTING.md")), *sorted(kept)]


def main(arguments: list[str]) -> None:
    """Print a row for each page, and for pages that are named also the sentences that break a rule.

    Parameters
    ----------
    arguments : list of str
        Paths of pages; all pages if empty.
    """
    print(
        f"{'page':34}{'words':>7}{'sentences':>11}{'mean':>7}{'longest':>9}{'openings':>10}{'avoided':>9}{'ambiguous':>11}"
    )
    total = Counter[str]()
    for path in [Path(name).resolve() for name in arguments] or pages():
        prose = prose_of(path.read_text(encoding="utf-8"))
        ambiguous = prose.containing(AMBIGUOUS)
        total.update(words=sum(prose.lengths), sentences=len(prose.sentences))
        print(
            f"{path.relative_to(ROOT).as_posix():34}{sum(prose.lengths):7}{len(prose.sentences):11}{prose.mean:7.1f}"
            f"{prose.longest:9}{len(prose.indirect()):10}{prose.containing(AVOIDED).total():9}{ambiguous.total():11}"
        )
        if arguments:
            for title, sentences in (("too long", prose.too_long()), ("opening", prose.indirect())):
                print(*(f"  {title}: {sentence}" for sentence in sentences), sep="\n", end="\n" if sentences else "")
            for title, counts in (("avoided", prose.containing(AVOIDED)), ("ambiguous", ambiguous)):
                print(*(f"  {title}: {phrase} ({count})" for phrase, count in counts.items()), sep="\n")
    print(f"{'all':34}{total['words']:7}{total['sentences']:11}{total['words'] / max(1, total['sentences']):7.1f}")


if __name__ == "__main__":
    main(sys.argv[1:])
