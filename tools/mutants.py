"""Small deliberate errors, and whether the tests catch them: `python tools/mutants.py --seed 1 --count 300`.

An error (a mutant) changes one place of a copy of the checkout: an operator, a comparison, a constant, a sign, a root.
Then the tests that enter the changed function run, those of its module and room first, until `--limit` seconds of
them are used. An error is caught if one of them fails or takes too long.

`--record` finds which test enters which function (`tools/entered.py`), again for files of tests that have changed.
Tests of texts, servers and whole programs are left out, unless they are named. `make mutants` names them for the errors
that are left (`--again`), with a longer limit.
The records and results are kept in `--folder`, so that a run can be stopped and continued. `--report` prints the share
that was caught.
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from entered import FOLDER, HOST, Entered, assigned, inside, is_recorded
from real_data import data_folder

ROOMS = ("geodesy", "models", "estimation", "block", "surface", "warp", "exchange", "raster", "points", "files")
ROOT = Path(__file__).resolve().parent.parent
#: Tests of no single room: of texts and sources, with browsers or servers, or of whole programs.
_APART = {
    "attack", "batch", "cli", "measure", "storage", "studies", "test_docs.py", "test_docstrings.py", "test_faults.py",
    "test_layers.py", "test_notebooks.py", "test_product_text.py", "test_recipes.py", "test_setup.py", "test_words.py",
}  # fmt: skip
_OPPOSITE = {
    ast.Add: ast.Sub, ast.Mult: ast.Div, ast.Lt: ast.GtE, ast.Gt: ast.LtE, ast.Eq: ast.NotEq, ast.Is: ast.IsNot,
    ast.In: ast.NotIn, ast.And: ast.Or, ast.BitAnd: ast.BitOr,
}  # fmt: skip
_OPPOSITE |= {other: one for one, other in _OPPOSITE.items()} | {ast.Pow: ast.Mult, ast.FloorDiv: ast.Div}
_BOUNDARY: dict[Any, Any] = {ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt}
_OTHER = {"min": "max", "minimum": "maximum", "nanmin": "nanmax", "floor": "ceil", "sin": "cos", "any": "all"}
_OTHER |= {other: one for one, other in _OTHER.items()}
_DROPPED = ("sqrt", "abs", "round", "rint", "radians", "degrees", "sorted", "exp", "log", "copy")
#: Calls whose arguments are texts or types.
_NO_RESULT = ("Text", "Setting", "Notice", "TypeVar", "NewType", "cast", "debug", "info", "warning", "counted")


class Mutant(NamedTuple):
    """One change: bytes `start` to `end` of a file become `text`.

    It is in a function, or in what a module or a class assigns to `names`.
    """

    path: str
    line: int
    start: int
    end: int
    before: str
    text: str
    function: str
    names: tuple[str, ...]

    @property
    def id(self) -> str:
        """What tells it from others."""
        return f"{self.path}:{self.line} ({self.start}): {self.before} -> {self.text}"


def mutants_of(path: str, source: bytes) -> Iterator[Mutant]:
    """Yield all mutants of a module."""
    starts = [0]
    for row in source.splitlines(keepends=True):
        starts.append(starts[-1] + len(row))
    for node, changed, function, names in _changes(ast.parse(source), "", ()):
        start = starts[node.lineno - 1] + node.col_offset
        end = starts[node.end_lineno - 1] + node.end_col_offset
        before = " ".join(source[start:end].decode().split())
        text = changed if isinstance(changed, str) else f"({ast.unparse(changed)})"
        yield Mutant(path, node.lineno, start, end, before, text, function, names)


def _changes(node: ast.AST, function: str, names: tuple[str, ...]) -> Iterator[tuple[Any, Any, str, tuple[str, ...]]]:
    """Yield nodes, what each becomes, and where it is."""
    skipped = {"annotation", "returns", "decorator_list", "keywords" if isinstance(node, ast.ClassDef) else ""}
    for field, value in ast.iter_fields(node):
        for child in (value if isinstance(value, list) else [value]) if field not in skipped else ():
            if not isinstance(child, ast.AST) or _is_no_result(child):
                continue
            within = inside(node, child, function)
            named = assigned(node, child) or ((within.rpartition(".")[2],) if within != function else names)
            yield from ((child, changed, within, named) for changed in _changed(child))
            yield from _changes(child, within, named)


def _is_no_result(node: ast.AST) -> bool:
    """Return whether a part is a text, a type or an import."""
    if isinstance(node, ast.If):
        return "TYPE_CHECKING" in ast.unparse(node.test)
    if isinstance(node, ast.Call):
        return _called(node) in _NO_RESULT
    if isinstance(node, ast.Expr):
        return isinstance(node.value, ast.Constant) or _is_no_result(node.value)
    return isinstance(node, (ast.Raise, ast.Assert, ast.JoinedStr, ast.Import, ast.ImportFrom))


def _called(node: ast.Call) -> str:
    return node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")


def _with(node: Any, **fields: Any) -> Any:
    return type(node)(**{**dict(ast.iter_fields(node)), **fields})


def _changed(node: Any) -> Iterator[Any]:
    """Yield what a node becomes, as a node or as text."""
    match node:
        case ast.BinOp(op=op) | ast.BoolOp(op=op) if type(op) in _OPPOSITE:
            yield _with(node, op=_OPPOSITE[type(op)]())
        case ast.Compare(ops=[op]):
            yield from (_with(node, ops=[kinds[type(op)]()]) for kinds in (_OPPOSITE, _BOUNDARY) if type(op) in kinds)
        case ast.AugAssign(op=op) if type(op) in _OPPOSITE:
            yield ast.unparse(_with(node, op=_OPPOSITE[type(op)]()))
        case ast.UnaryOp(op=ast.Not() | ast.USub() | ast.Invert()):
            yield node.operand
        case ast.Constant(value=bool()):
            yield repr(not node.value)
        case ast.Constant(value=int()):
            yield repr(node.value + 1)
        case ast.Constant(value=float()):
            yield f"({2 * node.value if node.value else 1.0})"
        case ast.Call(args=[first, *_]) if _called(node) in _DROPPED and not isinstance(first, ast.Starred):
            yield first
        case ast.Call(func=name) if _called(node) in _OTHER:
            field = "attr" if isinstance(name, ast.Attribute) else "id"
            yield _with(node, func=_with(name, **{field: _OTHER[_called(node)]}))
        case ast.Expr(value=ast.Call()):
            yield "pass"


class Copy:
    """A copy of the checkout in a temporary folder, with the same real scenes."""

    def __init__(self, above: str) -> None:
        self.root, self._listed = Path(above, "checkout"), Path(above, "tests.txt")
        line = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
        for name in subprocess.run(line, cwd=ROOT, check=True, capture_output=True, text=True).stdout.split("\0"):
            if (ROOT / name).is_file():
                (self.root / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(ROOT / name, self.root / name)

    def pytest(self, tests: list[str], timeout: float, *words: str, **more: str) -> tuple[str, str]:
        """Run tests; return how they ended (passed, failed, too long) and what they printed."""
        self._listed.write_text("\n".join(tests))
        path = os.pathsep.join(str(self.root / name) for name in (".", "plugins", "tools"))
        env = {**os.environ, "PYTHONPATH": path, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", **more}
        env |= {"ORTHO_REAL_DATA": str(data_folder())}
        line = [sys.executable, "-m", "pytest", "-q", "-m", "not slow", "-p", "no:cacheprovider", *words]
        process = subprocess.Popen(
            [*line, f"@{self._listed}"], cwd=self.root, env=env, text=True, start_new_session=True,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        )  # fmt: skip
        try:
            said, _ = process.communicate(timeout=timeout)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, 9)
            process.communicate()
            return "too long", ""
        return "failed" if process.returncode else "passed", said

    def try_out(self, mutant: Mutant, tests: list[str], timeout: float) -> tuple[str, str]:
        """Make an error, run tests, undo it."""
        file = self.root / mutant.path
        source = file.read_bytes()
        try:
            file.write_bytes(source[: mutant.start] + mutant.text.encode() + source[mutant.end :])
            # Python trusts a compiled module whose source has the same time (seconds) and size.
            os.utime(file, (random.randrange(10**9),) * 2)
            return self.pytest(tests, timeout, "-x", "--tb=line")
        finally:
            file.write_bytes(source)
            os.utime(file, (0, 0))

    def record(self, folder: Path, places: list[str]) -> None:
        """Note which tests enter which functions, for files of tests without a record, or changed since."""
        found = {ROOT / place for place in places if place.endswith(".py")}
        for place in places or ["tests"]:
            found.update((ROOT / place).glob("**/test_*.py"))
        for name in sorted(str(file.relative_to(ROOT)) for file in found):
            apart = not places and _APART & set(Path(name).parts)
            if not apart and not is_recorded(folder, ROOT, name):
                ended, said = self.pytest([name], 900, "-p", "entered", **{FOLDER: str(folder)})
                print(f"{name}: {ended}, {''.join(said.strip().splitlines()[-1:])}", flush=True)


def chosen(entered: Entered, mutant: Mutant, limit: float) -> list[str]:
    """Return tests for so many seconds, at least one: of the module, then of its room, then the shortest."""
    room, own = f"/{mutant.path.split('/')[1]}/", f"/test_{Path(mutant.path).stem}.py"

    def order(test: str) -> tuple[bool, bool, float, str]:
        return own not in test, room not in test, entered.seconds[test], test

    left, some = limit, list[str]()
    for test in sorted(entered.by(f"{mutant.path}:{mutant.function}", mutant.names), key=order):
        if not some or entered.seconds[test] <= left:
            left -= entered.seconds[test]
            some.append(test)
    return some


def try_all(copy: Copy, words: argparse.Namespace, records: Path) -> None:
    """Draw mutants, and try out those that have no record, or with `words.again` were not caught."""
    modules = [path for room in words.rooms for path in sorted((copy.root / HOST / room).rglob("*.py"))]
    every = [one for path in modules for one in mutants_of(str(path.relative_to(copy.root)), path.read_bytes())]
    done = {name for name, row in read(records).items() if row["caught"] or not words.again}
    entered = Entered(words.folder / "map", copy.root)
    for mutant in random.Random(words.seed).sample(every, min(words.count, len(every)))[words.first :]:
        if mutant.id in done:
            continue
        began, tests = time.monotonic(), chosen(entered, mutant, words.limit)
        ended, said = copy.try_out(mutant, tests, 60 + 5 * words.limit) if tests else ("no test", "")
        by = next((row[:200] for row in said.splitlines() if row.startswith(("FAILED", "ERROR"))), "")
        seconds = round(time.monotonic() - began)
        caught = ended in ("failed", "too long")
        row = {"id": mutant.id, "ended": ended, "caught": caught, "tests": len(tests), "by": by, "seconds": seconds}
        with records.open("a") as file:
            file.write(json.dumps(row) + "\n")
        print(f"{ended:8} {seconds:4} s  {mutant.id}", flush=True)


def read(records: Path) -> dict[str, dict[str, Any]]:
    """Return the last record of each mutant."""
    rows = map(json.loads, records.read_text().splitlines() if records.is_file() else ())
    return {row["id"]: row for row in rows}


def report(records: Path) -> None:
    """Print the share that was caught, and what was not."""
    rows = read(records).values()
    left = sorted(f"  {row['id']}  [{row['tests']} tests]" for row in rows if not row["caught"])
    caught = len(rows) - len(left)
    print(f"{records.stem}: {len(rows)} mutants, {caught} caught ({caught / max(len(rows), 1):.1%}). Not caught:")
    print(*left, sep="\n")


def main() -> None:
    """Parse the words, and record, try out or report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--count", type=int, default=300, help="mutants, those of earlier runs included")
    parser.add_argument("--first", type=int, default=0, help="with which one to begin; others are for another process")
    parser.add_argument("--limit", type=float, default=30, help="seconds of tests for a mutant")
    parser.add_argument("--folder", type=Path, default=ROOT / "out" / "mutants")
    parser.add_argument("--rooms", nargs="*", default=ROOMS)
    parser.add_argument("--record", nargs="*", metavar="TESTS", help="files or folders of tests; all without")
    parser.add_argument("--again", action="store_true", help="try out once more what was not caught")
    parser.add_argument("--report", action="store_true")
    words = parser.parse_args()
    words.folder = words.folder.resolve()
    words.folder.mkdir(parents=True, exist_ok=True)
    records = words.folder / f"seed-{words.seed}.jsonl"
    if not words.report:
        with tempfile.TemporaryDirectory() as above:
            if words.record is not None:
                Copy(above).record(words.folder / "map", words.record)
                return
            try_all(Copy(above), words, records)
    report(records)


if __name__ == "__main__":
    main()
