"""The documentation is short, and written in plain words: the limits of tools/words.py."""

from __future__ import annotations

from pathlib import Path

import pytest
import words

ROOT = Path(__file__).resolve().parents[1]


def test_the_user_documentation_can_be_read():
    assert words.total(words.user_pages(ROOT)) <= words.TOTAL


def test_the_pages_for_engineers_can_be_read():
    assert words.total(words.engineering_pages(ROOT)) <= words.LIMITS["docs/engineering"]


@pytest.mark.parametrize("page", words.written_pages(ROOT), ids=lambda page: words.name_of(page, ROOT))
def test_a_page_is_short_and_plain(page: Path):
    assert words.faults(page, ROOT) == []


def test_only_long_tables_may_be_longer():
    names = {words.name_of(page, ROOT) for page in words.user_pages(ROOT)}
    assert set(words.LONGER) <= names, "a page of the list is not there any more"
    assert all(" " in phrase and phrase == phrase.lower() for phrase in words.PHRASES)


PAGE = """# A heading of five words

One sentence with `ortho rectify --gcps points.csv` in it. A second one, on
two lines, with a [link of four words](https://example.org/a-b_c).

<!-- a comment -->
```
ortho rectify scene.tif
```

| name | what it is |
|---|---|
| `x` | This cell is said to be read. |

- First item of a list
- [![A picture of it](images/a.png)](page.md)
"""


def test_all_that_is_read_counts_and_code_in_fences_does_not():
    # Heading 5, first sentence 9, second 12, table 4 and 8, list 5 and 4.
    assert words.words(PAGE) == 5 + 9 + 12 + 4 + 8 + 5 + 4
    assert words.sentences(PAGE) == [
        "One sentence with code in it.",
        "A second one, on two lines, with a link of four words.",
        "This cell is said to be read.",
        "First item of a list",
        "A picture of it",
    ]
    assert words.phrases(PAGE) == ["is said"]


def test_long_pages_and_long_sentences_are_named(tmp_path: Path):
    (tmp_path / "docs").mkdir()
    page = tmp_path / "docs" / "long.md"
    page.write_text("\n\n".join("This sentence has five words." for _ in range(301)))
    assert words.faults(page, tmp_path) == ["has 1505 words, at most 1500 are allowed"]
    page.write_text("\n\n".join([" ".join(["word"] * 31)] * 2))
    assert words.faults(page, tmp_path) == [
        "its median sentence has 31 words, at most 16 are allowed",
        "1 in 20 sentences is longer than 31 words, at most 30 are allowed",
    ]
