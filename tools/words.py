"""Measure the documentation: `python tools/words.py [FOLDER OF THE REPOSITORY]`.

Prints the words of each page, the total of the user documentation, and what breaks the rules.

What counts as a word: everything that a person reads on the page, except fenced code. So headings, paragraphs, lists,
cells of tables, inline code and the texts of links and pictures count. Fenced code, comments, addresses of links,
attributes of headings and signs without a letter or a digit do not.

The user documentation is README.md and docs/, without docs/engineering/ and without generated pages
(docs/reference/, docs/commands/). CHANGELOG.md, SECURITY.md and docs/engineering/ are counted by themselves.

Sentences are those of paragraphs, lists and cells of tables, without headings. Inline code counts as one word
there. What has fewer than four words (a number, a label) is no sentence.
"""

from __future__ import annotations

import re
import statistics
import sys
from collections.abc import Iterator
from pathlib import Path

TOTAL, PAGE = 35_000, 1_500
MEDIAN, NEARLY_ALL = 16, 30
#: Limits of single files, and of the folder for engineers, in words.
LIMITS = {"README.md": 700, "CHANGELOG.md": 2_500, "docs/engineering": 12_000}
#: Pages that may be longer, and why.
LONGER = {
    "docs/formats.md": "tables of files and their fields",
    "docs/formats/block-points.md": "tables of columns and of fields",
    "docs/notices.md": "a table of all notices",
}
GENERATED = ("docs/reference/", "docs/commands/")
#: Wordings that the language guide of this project replaces; each has two words or more.
PHRASES = (
    "an indication, no claim",
    "and there are none",
    "and there is none",
    "are asked",
    "are said",
    "asked for were",
    "assumed is",
    "begin anew",
    "beside other programs",
    "by hand of",
    "by the network",
    "by this indication",
    "cannot be told",
    "click it anew",
    "control without hands",
    "does not do what was asked",
    "files of the network",
    "finds nothing, or",
    "folds the ground",
    "found in sight of",
    "go on silently",
    "goes on silently",
    "have the last word",
    "heights that are found",
    "is asked",
    "is said",
    "is was",
    "it is not in the figure",
    "it lies",
    "it was looked for",
    "judge all files",
    "keep apart",
    "keeps apart",
    "kept apart",
    "leads away",
    "leads elsewhere",
    "lean on",
    "leans on",
    "let the interpreter go",
    "lets the interpreter go",
    "lies metres off",
    "make the worst place",
    "measure next at",
    "measure some there",
    "no journal of them",
    "no point tests it",
    "nobody can say",
    "nobody has",
    "nobody says",
    "nobody stated",
    "not opened unasked",
    "not tested not tested",
    "of the network",
    "on this machine alone",
    "one needs which",
    "owed to the",
    "page anew",
    "px stands out",
    "recognised and said",
    "say it",
    "say nothing",
    "say on stderr",
    "say where it",
    "says it with",
    "says nothing",
    "settle this first",
    "shall be",
    "shall not",
    "share would not show",
    "stand in",
    "stand there",
    "stands in",
    "stands there",
    "stood in for",
    "taken in sight of",
    "taken to be within",
    "takes them up",
    "tells most",
    "they lie",
    "to be kept",
    "too much alike",
    "unreported earlier run",
    "vanish from residuals",
    "was asked",
    "was looked for",
    "was said",
    "what it is fit for",
    "what stands",
    "what stands here",
    "whatever their dates say",
    "where control is",
    "which says",
    "without a hand",
    "would be told",
    "would do for",
)


#: A block of code.
FENCED = re.compile(r"^( *)(```+|~~~+).*?^\1?\2[ ]*$", re.DOTALL | re.MULTILINE)
#: Between two sentences; code or an option may begin one.
_END = re.compile(r"(?<=[.!?:])[)\"*”]*\s+(?=[\"'(*“]*[A-Z0-9])|(?<=[.!?])[)\"*”]*\s+(?=code\b|'?--[a-z])")


def user_pages(root: Path) -> list[Path]:
    """Return the pages of the user documentation."""
    pages = [root / "README.md", *sorted((root / "docs").rglob("*.md"))]
    return [page for page in pages if not name_of(page, root).startswith((*GENERATED, "docs/engineering/"))]


def engineering_pages(root: Path) -> list[Path]:
    """Return the pages for those who work on the code."""
    return sorted((root / "docs" / "engineering").rglob("*.md"))


def written_pages(root: Path) -> list[Path]:
    """Return all pages whose wording is tested."""
    return [*user_pages(root), *engineering_pages(root), root / "SECURITY.md", root / "CHANGELOG.md"]


def name_of(page: Path, root: Path) -> str:
    """Return the path of a page from the root, with slashes."""
    return page.relative_to(root).as_posix()


def readable(text: str) -> str:
    """Return a page without fenced code, comments, addresses and attributes."""
    text = FENCED.sub("", text)
    text = re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL)
    text = re.sub(r"\{[ :#.][^}\n]*\}", "", text)
    text = re.sub(r"!?\[([^\]]*)\]\([^)\s]*(?: \"[^\"]*\")?\)", r"\1", text)
    # A picture within a link leaves its own link behind.
    return re.sub(r"!?\[([^\]]*)\]\([^)\s]*\)", r"\1", text)


def words(text: str) -> int:
    """Return how many words a reader meets in the text of a page."""
    return sum(bool(re.search(r"[^\W_]", word)) for word in re.split(r"[\s|]+", readable(text)))


def sentences(text: str) -> list[str]:
    """Return the sentences of a page, each with its inline code as one word."""
    text = re.sub(r"`[^`\n]+`", "code", readable(text))
    text = re.sub(r"</?(?:table|thead|tbody|tr|th|td|p)\b[^>]*>", "\n\n", text)  # cells of a notebook's tables
    found = [part for block in blocks(text) for part in _END.split(block)]
    return [sentence.strip() for sentence in found if length(sentence) >= 4]


def length(sentence: str) -> int:
    """Return the words of a sentence."""
    return sum(bool(re.search(r"[^\W_]", word)) for word in sentence.split())


def blocks(text: str) -> Iterator[str]:
    """Yield paragraphs, items of lists and cells of tables, each on one line."""
    lines: list[str] = []
    for line in [*text.splitlines(), ""]:
        bare = line.strip()
        row, heading = bare.startswith("|"), bare.startswith(("#", "===", "---"))
        begins = re.match(r"([-*+]|\d+\.) ", bare)
        if lines and (not bare or row or heading or begins):
            yield " ".join(lines)
            lines = []
        if row:
            yield from (cell.strip() for cell in re.split(r"(?<!\\)\|", bare.strip("|")))
        elif bare and not heading:
            lines.append(bare[begins.end() :] if begins else bare)


def phrases(text: str) -> list[str]:
    """Return the wordings of `PHRASES` that a page has."""
    text = " ".join(readable(text).lower().split())
    return [phrase for phrase in PHRASES if re.search(rf"\b{re.escape(phrase)}\b", text)]


def faults(page: Path, root: Path) -> list[str]:
    """Return which rules of length and wording a page breaks."""
    text, name = page.read_text(encoding="utf-8"), name_of(page, root)
    count = words(text)
    limit = LIMITS.get(name, None if name in LONGER or "engineering" in name else PAGE)
    found = [f'has "{phrase}"' for phrase in phrases(text)]
    if limit is not None and count > limit:
        found.append(f"has {count} words, at most {limit} are allowed")
    return found + faults_of_lengths(sentences(text))


def faults_of_lengths(texts: list[str]) -> list[str]:
    """Return which rules of length sentences break together."""
    found = []
    lengths = sorted(map(length, texts))
    if len(lengths) > 1:
        middle, nearly_all = statistics.median(lengths), statistics.quantiles(lengths, n=20, method="inclusive")[-1]
        if middle > MEDIAN:
            found.append(f"its median sentence has {middle:.3g} words, at most {MEDIAN} are allowed")
        if nearly_all > NEARLY_ALL:
            found.append(f"1 in 20 sentences is longer than {nearly_all:.3g} words, at most {NEARLY_ALL} are allowed")
    return found


def total(pages: list[Path]) -> int:
    """Return the words of several pages."""
    return sum(words(page.read_text(encoding="utf-8")) for page in pages)


def main() -> None:
    """Print words and faults."""
    root = Path(sys.argv[1] if len(sys.argv) > 1 else Path(__file__).parent.parent).resolve()
    for page in written_pages(root):
        print(f"{words(page.read_text(encoding='utf-8')):7,d}  {name_of(page, root)}")
        for fault in faults(page, root):
            print(f"         {fault}")
    print(f"{total(user_pages(root)):7,d}  user documentation; at most {TOTAL:,d}")
    print(f"{total(engineering_pages(root)):7,d}  docs/engineering; at most {LIMITS['docs/engineering']:,d}")


if __name__ == "__main__":
    main()
