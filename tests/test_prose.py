"""Sentences of the documentation: their length, their openings, and phrases that have a plainer form."""

from __future__ import annotations

import pytest
from prose import AVOIDED, LONGEST_LIMIT, MEAN_LIMIT, ROOT, pages, prose_of, words

PAGES = pytest.mark.parametrize("page", pages(), ids=lambda path: path.relative_to(ROOT).as_posix())


@PAGES
def test_sentences_are_short(page):
    prose = prose_of(page.read_text(encoding="utf-8"))
    assert prose.too_long() == [], f"sentences of more than {LONGEST_LIMIT} words"
    assert prose.mean < MEAN_LIMIT


@PAGES
def test_sentences_open_with_their_subject(page):
    assert prose_of(page.read_text(encoding="utf-8")).indirect() == []


@PAGES
def test_phrases_with_a_plainer_form_are_absent(page):
    assert dict(prose_of(page.read_text(encoding="utf-8")).containing(AVOIDED)) == {}


def test_code_tables_and_formulas_are_left_out():
    text = """---
kernelspec: {name: python3}
---

# A heading of five words

One sentence has `code` and $x^2$ and [a link](of/a/page.md). Another one follows, e.g. this.

    an indented block of code

```python
print("a block of code")
```

| a | table |
|---|---|

- an item that
  goes on

  ```text
  code in an item
  ```
- What is next?
- What is next

$$x = 1.$$
"""
    prose = prose_of(text)
    assert prose.sentences == (
        "One sentence has CODE and FORMULA and a link.",
        "Another one follows, e.g. this.",
        "an item that goes on",
        "What is next?",
        "What is next",
        "FORMULA",
    )
    assert prose.lengths == [9, 5, 5, 3, 3, 1]
    assert prose.indirect() == ["What is next"]


def test_long_sentences_and_phrases_are_found():
    long = " ".join(["word"] * (LONGEST_LIMIT + 1)) + "."
    prose = prose_of(f"{long} It stands Beside another one. Besides, it is short.")
    assert len(words(long)) == LONGEST_LIMIT + 1
    assert prose.too_long() == [long]
    assert prose.containing(AVOIDED) == {"beside": 1}
