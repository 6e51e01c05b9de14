"""Read damaged files with every reader: `make fuzz [N=100000] [READER=name] [KEEP=folder]`.

A mutant is either read, and all numbers that come of it are finite, or refused by an `OrthoError` that names the file,
the field where there is one, and a remedy; within 5 seconds of processor time. Each reader runs in a process of its
own, two at a time, so that one that dies is seen as well. With `--keep` the results lie in a folder while it runs, and
the next run goes on behind them.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import json
import logging
import math
import multiprocessing
import os
import random
import re
import signal
import sys
import tempfile
import threading
import time
import traceback
import warnings
import zlib
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

# As a script it runs without the paths of pytest.
sys.path += [str(Path(__file__).resolve().parents[1] / "sensors"), str(Path(__file__).resolve().parents[2] / "tools")]

from mutate import mutant
from osgeo import gdal
from readers import BY_NAME, READERS, Reader, numbers
from real_seeds import real_seeds

from ortho_pipeline.errors import OrthoError

#: Seconds of processor time that a file may take, and seconds without a sign of life after which a reader hangs.
SLOWEST, SILENCE = 5.0, 600.0
#: Mutants between two tallies that a process hands over.
_PART = 500
#: What is wrong with a file as a whole, and so with no field of it.
WHOLE = re.compile(
    r"cannot be read|not read|not text|binary|UTF-16|not UTF-8|well-formed|no RPC|no points"
    r"|(more|larger) than .* (MB|bytes)|plain ASCII|(is|must be) a JSON object|is empty|no such file|GDAL cannot open"
    r"|cannot hold points of several images|is not in this table"
    r"|this (is|file is|file has) no|there is no .* in this file|nothing in|cut off|too large, or not text|no text"
)
_VARYING = re.compile(r"'[^']*'|\".*|[(].*|[0-9.]+")


@dataclass
class Tally:
    """What became of the mutants of one reader; `faults` are the first of each kind, with their numbers."""

    reader: str
    mutants: int = 0
    accepted: int = 0
    refused: int = 0
    untyped: int = 0
    infinite: int = 0
    unnamed: int = 0
    unremedied: int = 0
    slow: int = 0
    died: int = 0
    slowest: float = 0.0
    faults: dict[str, tuple[int, int, str]] = field(default_factory=dict)

    @property
    def sound(self) -> bool:
        """Whether nothing was found."""
        return not (self.untyped or self.infinite or self.unnamed or self.unremedied or self.slow or self.died)

    def note(self, kind: str, what: str, number: int) -> None:
        """Keep the first example of a fault, and count it."""
        # Numbers and what is quoted of the file differ from mutant to mutant.
        key = f"{kind}: " + _VARYING.sub("#", what)[:90]
        count, first, text = self.faults.get(key, (0, number, what))
        self.faults[key] = (count + 1, first, text)


class TooSlow(BaseException):
    """Raised by the timer; no reader catches it."""


@contextlib.contextmanager
def limited() -> Iterator[None]:
    """Interrupt what takes more than `SLOWEST` seconds of processor time."""

    def stop(*_: Any) -> None:
        raise TooSlow

    before = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, SLOWEST)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)


class Attack:
    """One reader, its valid file in a folder of its own, and its mutants by their numbers."""

    def __init__(self, reader: Reader, folder: Path, real: Path | None = None) -> None:
        self.reader, self.path = reader, folder / reader.file
        # The seed puts next to it what has to lie there.
        self.data = reader.seed(folder)
        if real is not None:
            self.data = real.read_bytes()
        self.path.write_bytes(self.data)
        self.tally = Tally(reader.name)

    def check_seed(self) -> None:
        """Raise if the valid file is refused, or does not give finite numbers."""
        assert not [x for x in numbers(self.reader.read(self.path)) if self.bad(x)]

    def bad(self, number: float) -> bool:
        """Tell whether a number may not come of a file."""
        return math.isinf(number) or (math.isnan(number) and not self.reader.unknown)

    def file(self, number: int) -> bytes:
        """Return a mutant."""
        return mutant(self.data, self.reader.kind, random.Random(zlib.crc32(self.reader.name.encode()) + number))

    def judge(self, number: int) -> None:
        """Read a mutant, and count what became of it."""
        self.path.write_bytes(self.file(number))
        tally, begin = self.tally, time.process_time()
        tally.mutants += 1
        try:
            with limited():
                found = self.reader.read(self.path)
                bad = [one for one in numbers(found) if self.bad(one)]
        except OrthoError as error:
            tally.refused += 1
            self._judge_refusal(error, number)
        except TooSlow:
            tally.slow += 1
            tally.note("slow", "".join(traceback.format_stack(limit=1)), number)
        except Exception as error:
            last = traceback.extract_tb(error.__traceback__)[-1]
            tally.untyped += 1
            tally.note("untyped", f"{type(error).__name__} in {Path(last.filename).name}:{last.name}: {error}", number)
        else:
            tally.accepted += 1
            if bad:
                tally.infinite += 1
                tally.note("not finite", str(bad[:3]), number)
        tally.slowest = max(tally.slowest, time.process_time() - begin)

    def _judge_refusal(self, error: OrthoError, number: int) -> None:
        named = (error.file or not self.reader.of_files) and (error.field or WHOLE.search(error.message))
        if not named:
            self.tally.unnamed += 1
            self.tally.note("unnamed", f"{error.file and 'file'} {error.field}: {error.message}", number)
        if not error.remedy:
            self.tally.unremedied += 1
            self.tally.note("no remedy", f"{error.field}: {error.message}", number)


def scratch() -> tempfile.TemporaryDirectory[str]:
    """Return a temporary folder, in memory where there is such a file system."""
    memory = Path("/dev/shm")
    return tempfile.TemporaryDirectory(dir=memory if os.access(memory, os.W_OK) else None)


# -- by hand ---------------------------------------------------------------------------------------------------------


def hush() -> None:
    """Let nothing be printed: damaged files make GDAL, numpy and the project's log speak."""
    warnings.simplefilter("ignore")
    np.seterr(all="ignore")
    logging.disable(logging.CRITICAL)
    gdal.UseExceptions()
    gdal.PushErrorHandler("CPLQuietErrorHandler")


def _work(name: str, first: int, count: int, alive: Any, pipe: Any) -> None:
    hush()
    with scratch() as folder:
        one = Attack(BY_NAME[name], Path(folder))
        for number in range(first, first + count):
            alive.value = number
            one.judge(number)
            if number % _PART == _PART - 1:
                pipe.send(one.tally)
        pipe.send(one.tally)
        pipe.close()


class Kept:
    """The results of one reader in a folder, so that a run that is stopped keeps what it did."""

    def __init__(self, folder: Path | None, name: str, first: int) -> None:
        self.path = folder and folder / f"{name}.json"
        self.first, self.next, self.tally = first, first, Tally(name)
        if self.path and self.path.exists():
            found = json.loads(self.path.read_text())
            if found["first"] != first:
                sys.exit(f"{self.path} begins with mutant {found['first']}, not {first}")
            self.next, self.tally = found["next"], Tally(**found["tally"])

    def write(self, behind: int, tally: Tally) -> None:
        """Keep what became of the mutants up to `behind`, which is not among them."""
        if self.path:
            document = {"first": self.first, "next": behind, "tally": asdict(tally)}
            part = self.path.with_suffix(".part")
            part.write_text(json.dumps(document, indent=1) + "\n")
            part.replace(self.path)


def run(name: str, first: int, count: int, folder: Path | None = None) -> Tally:
    """Attack one reader in a process of its own, and again behind the mutant at which that died or hung."""
    kept = Kept(folder, name, first)
    total, at, end = kept.tally, kept.next, first + count
    context = multiprocessing.get_context("fork")
    while at < end:
        alive, (ours, theirs) = context.Value("q", at), context.Pipe(duplex=False)
        worker = context.Process(target=_work, args=(name, at, end - at, alive, theirs))
        worker.start()
        theirs.close()
        last, seen, part = time.monotonic(), -1, Tally(name)
        while True:
            try:
                if ours.poll(1.0):
                    part = ours.recv()
                    kept.write(at + part.mutants, _sum(total, part))
            except EOFError:
                break
            if alive.value != seen:
                seen, last = alive.value, time.monotonic()
            elif time.monotonic() - last > SILENCE:
                worker.kill()
                break
        worker.join()
        total = _sum(total, part)
        if worker.exitcode == 0:
            break
        total.died += 1
        total.note("died", f"exit code {worker.exitcode}", alive.value)
        # The mutants since the last tally are not counted.
        at = alive.value + 1
        kept.write(at, total)
    return total


def run_all(names: list[str], first: int, count: int, processes: int, folder: Path | None = None) -> list[Tally]:
    """Attack several readers, so many at a time."""
    left, done = list(reversed(names)), {}

    def work() -> None:
        while left:
            name = left.pop()
            done[name] = run(name, first, count, folder)
            print(f"{name}: {done[name].mutants} mutants", file=sys.stderr)

    # No pool: what that does at the end of a process fails in one that was forked from its threads.
    threads = [threading.Thread(target=work) for _ in range(processes)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return [done[name] for name in names]


def _sum(first: Tally, second: Tally) -> Tally:
    total = Tally(first.reader, slowest=max(first.slowest, second.slowest), faults=dict(first.faults))
    for name in ("mutants", "accepted", "refused", "untyped", "infinite", "unnamed", "unremedied", "slow", "died"):
        setattr(total, name, getattr(first, name) + getattr(second, name))
    for key, (count, number, text) in second.faults.items():
        before = total.faults.get(key, (0, number, text))
        total.faults[key] = (before[0] + count, *before[1:])
    return total


def table(tallies: list[Tally]) -> str:
    """Return the tallies as a table in Markdown."""
    rows = [
        "| reader | mutants | accepted | refused | untyped | not finite | field or file not named | without remedy | "
        "over 5 s | died | slowest, s |",
        "|---|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|",
    ]
    for one in (*tallies, functools.reduce(_sum, tallies, Tally("all"))):
        rows.append(
            f"| {one.reader} | {one.mutants} | {one.accepted} | {one.refused} | {one.untyped} | {one.infinite} | "
            f"{one.unnamed} | {one.unremedied} | {one.slow} | {one.died} | {one.slowest:.2f} |"
        )
    return "\n".join(rows)


def attack_real(names: list[str] | None, first: int, count: int) -> int:
    """Attack the readers of which there are real files, with each of these as the seed."""
    hush()
    tallies = []
    for name, path in real_seeds():
        if names is None or name in names:
            with scratch() as folder:
                one = Attack(BY_NAME[name], Path(folder), path)
                one.check_seed()
                for number in range(first, first + count):
                    one.judge(number)
            one.tally.reader = f"{name}, {path.name}"
            print(f"{one.tally.reader}: {one.tally.mutants} mutants", file=sys.stderr, flush=True)
            tallies.append(one.tally)
    return report(tallies)


def report(tallies: list[Tally]) -> int:
    """Print what became of the mutants; return 1 if anything was found."""
    print(table(tallies))
    for one in tallies:
        for key, (number_of, number, text) in sorted(one.faults.items(), key=lambda item: -item[1][0]):
            print(f"{one.reader}: {number_of} x {key.partition(':')[0]} (first: mutant {number}): {text[:300]}")
    return 0 if all(one.sound for one in tallies) else 1


def main(arguments: list[str]) -> int:
    """Run by hand; exit code 1 if anything was found."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-n", type=int, default=100_000, help="mutants of each reader")
    parser.add_argument("--first", type=int, default=0, help="number of the first")
    parser.add_argument("--reader", action="append", choices=sorted(BY_NAME), help="only these")
    parser.add_argument("--show", type=int, help="write this mutant of the reader to standard output")
    parser.add_argument(
        "--keep", type=Path, help="folder for the results; what it holds is not run again (-n 0: shown)"
    )
    parser.add_argument("-j", type=int, default=2, help="processes")
    parser.add_argument("--real", action="store_true", help="of the real files, one after the other")
    chosen = parser.parse_args(arguments)
    names = chosen.reader or [reader.name for reader in READERS]
    if chosen.show is not None:
        with scratch() as folder:
            sys.stdout.buffer.write(Attack(BY_NAME[names[0]], Path(folder)).file(chosen.show))
        return 0
    if chosen.real:
        return attack_real(chosen.reader, chosen.first, chosen.n)
    if chosen.keep:
        chosen.keep.mkdir(parents=True, exist_ok=True)
    tallies = run_all(names, chosen.first, chosen.n, chosen.j, chosen.keep)
    return report(tallies)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
