"""All texts that the product shows are in plain words and short sentences: the limits of tools/words.py."""

from __future__ import annotations

from pathlib import Path

import product_text
import words

ROOT = Path(__file__).resolve().parents[1]


def test_the_texts_of_all_rooms_are_plain() -> None:
    told = []
    for room, texts in product_text.by_room(ROOT).items():
        if faults := product_text.faults(texts):
            told += [f"{room}:", *faults, *product_text.offenders(texts)]
    assert not told, "\n".join(told)


def test_every_kind_of_text_is_found() -> None:
    texts = product_text.shown(ROOT)
    kinds = {one.kind for one in texts}
    assert kinds == {"message", "remedy", "notice", "help", "text", "page", "script", "docs"}
    for text in texts:  # where it says
        assert text.line <= (ROOT / text.path).read_text(encoding="utf-8").count("\n") + 1, text


SOURCE = '''"""Only programmers read this docstring."""
WORDS = ("one", f"two words of {len('a longer value')}")

@cli.command()
def rectify():
    """Make an orthoimage."""
    logger.debug("no person reads this")
    if wrong:
        raise InputError(
            f"the file has {count} columns",
            remedy=Text("give ", Setting("points.crs", "CRS"), " too" if crs else ", or another file"),
        )
    return Notice("dem-part", "the DEM covers a part" + (" of it" if part else ""))
'''
PAGE = """<title>A page of {{ count }} rows</title>
{# a comment to authors #}
<p>Good <b>enough</b> for {% if plan %}maps{% elif view %}views of
the place{% else %}nothing yet{% endif %}.</p>
<td title="in pixels, always">{{ 'not known' if x is none else x }}</td>
<style>p { color: red blue }</style>
<script>const text = "Click the image";</script>
"""
SCRIPT = """// a comment of words
const quote = /"[^"]/g; /* "not shown here" */
say(`Point ${point.name} is ${on ? "switched on" : 'switched off'}.`, "px", 'Go on');
"""


def test_strings_of_python_are_read_as_people_meet_them() -> None:
    assert list(product_text.of_python(SOURCE)) == [
        ("text", 2, "two words of X"),
        ("text", 2, "a longer value"),
        ("help", 5, "Make an orthoimage."),
        ("message", 10, "the file has X columns"),
        ("remedy", 11, "give XX"),
        ("remedy", 11, ", or another file"),
        ("notice", 13, "the DEM covers a partX"),
        ("notice", 13, " of it"),
    ]


def test_pages_are_read_as_people_meet_them() -> None:
    assert sorted(product_text.of_page(PAGE), key=lambda row: row[1]) == [
        ("page", 1, "A page of X rows"),
        ("page", 3, "Good enough for maps."),
        ("page", 3, "views of the place"),
        ("page", 4, "nothing yet"),
        ("page", 5, "not known"),
        ("page", 5, "in pixels, always"),
        ("script", 7, "Click the image"),
    ]


def test_strings_of_scripts_are_read_as_people_meet_them() -> None:
    assert list(product_text.of_script(SCRIPT)) == [
        ("script", 3, "switched on"),
        ("script", 3, "switched off"),
        ("script", 3, "Point X is X."),
        ("script", 3, "Go on"),
    ]


def test_phrases_and_long_sentences_fail() -> None:
    def text(line: str) -> product_text.Shown:
        return product_text.Shown("message", "points", "points.py", 7, line)

    assert product_text.faults([text("This is said twice. It is short enough.")]) == [
        'points.py:7 (message) has "is said"'
    ]
    long = text(" ".join(["word"] * 31))
    assert product_text.faults([long, long]) == [
        "its median sentence has 31 words, at most 16 are allowed",
        "1 in 20 sentences is longer than 31 words, at most 30 are allowed",
    ]
    assert product_text.offenders([long]) == [f"points.py:7 (message) 31 words: {long.text}"]
    assert words.NEARLY_ALL == 30
