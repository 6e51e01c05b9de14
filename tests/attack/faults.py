"""Faults on purpose: commands that are limited, killed, cut off and led astray, and what has to be true afterwards.

Every command runs in a process of its own, forked from this one (which has loaded the libraries, but called none of
them), through the command line's own entry point. The check is always the same: the outputs are one whole set of files,
all of the run before or all of this one, exit code 0 means those of this one, what failed says so in a line with a
remedy, and after the next run nothing is left under a temporary name.

    python tests/attack/faults.py --limits 400 --kills 300        (make faults)
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import json
import mmap
import os
import random
import re
import resource
import select
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

SAMPLE = Path(__file__).resolve().parents[2] / "sample_data"
#: Seconds after which a command that was to end is taken to hang.
PATIENCE = 120.0
#: Of the sample scene, in its UTM zone: 240 x 240 pixels in the middle.
EXTENT = ("530600", "4122000", "531200", "4122600")
#: What a run says of itself is not the same twice: times and a log.
_OF_THE_RUN = re.compile(r"run\.jsonl?$|\.run/")
#: The files that a command leaves out if it cannot write its report.
_OF_THE_REPORT = re.compile(r"\.html$|_report\.json$|_residuals\.(geojson|qml)$|^points\.json$")
Files = dict[str, str]


# -- commands --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Case:
    """A command whose outputs are attacked.

    Parameters
    ----------
    words : tuple of str
        The command; its outputs lie in ``out`` of the current folder.
    before : tuple of str
        The command of the run before, whose outputs are others of the same names.
    names : tuple of (str, str)
        Folder and name of each set of outputs, as `files.together` has them.
    parts : dict of str to tuple of str
        For a run: the command that makes one of its scenes only, which is what a run has to leave that fails with the
        others.
    """

    name: str
    words: tuple[str, ...]
    before: tuple[str, ...]
    names: tuple[tuple[str, str], ...]
    parts: dict[str, tuple[str, ...]] = field(default_factory=dict)


def cases(inputs: Path) -> list[Case]:
    """Return a case for each way of writing; `inputs` is a copy of the sample data with two pipeline files."""
    scene, dem, gcps = (str(inputs / name) for name in ("scene.tif", "dem.tif", "gcps.geojson"))
    stereo = tuple(str(inputs / "cartosat" / name) for name in ("BANDF.tif", "BANDA.tif"))
    rays = ("--points", str(inputs / "cartosat" / "points.csv"), "--model", "rpc")
    whole = (("out", "scene"),)
    rectify = ("rectify", scene, "--gcps", gcps, "--dem", dem, "-te", *EXTENT, "-o", "out")
    found = [
        Case(f"rectify {name}", (*rectify, *more), (*rectify, *more, "-r", "nearest"), whole)
        for name, more in {
            "COG": (),
            "GTiff": ("--format", "GTiff"),
            "GTiff TILED=NO": ("--format", "GTiff", "-co", "TILED=NO"),
            "STAC": ("--stac", "--acquired", "2005-08-03T08:12:31Z"),
        }.items()
    ]
    for name in ("rpc-txt", "rpb", "tag", "vrt", "gcp", "gcp-tag", "geolocation", "rpc-txt,tag,vrt"):
        words = ("export", scene, "--dem", dem, "--format", name, "--force", "-o", "out")
        found.append(Case(f"export {name}", (*words, "--gcps", gcps), words, whole))
    adjust = ("adjust", *stereo, *rays, "-o", "out", "--correction")
    found.append(Case("adjust", (*adjust, "affine"), (*adjust, "shift"), (("out", "block"),)))
    intersect = ("intersect", *stereo, *rays, "-o", "out/points.geojson")
    found.append(Case("intersect", intersect, (*intersect, "--pixel-origin", "center"), (("out", "points.geojson"),)))
    compare = ("compare", scene, "--gcps", gcps, "--dem", dem, "-o", "out", "--models")
    found.append(Case("compare", (*compare, "rpc+shift,affine2d,affine3d"), (*compare, "rpc+shift,affine2d"), whole))
    simulate = ("simulate", "cartosat", "--size", "200", "-o", "out", "--seed")
    found.append(Case("simulate", (*simulate, "2"), (*simulate, "3"), (("out", "simulated"),)))
    bands = tuple(str(inputs / f"{band}.tif") for band in ("a", "b"))
    register = ("register", *bands, "-o", "out", "--transform")
    found.append(Case("register", (*register, "affine"), (*register, "similarity"), (("out", "a_bands"),)))
    orthos = tuple(str(inputs / f"{name}_ortho.tif") for name in ("west", "east"))
    mosaic = ("mosaic", *orthos, "-o", "out/mosaic.tif", "--order", "first-on-top")
    for more in ("--seamlines", "--balance"):
        found.append(Case(f"mosaic {more}", (*mosaic, more), mosaic, (("out", "mosaic"),)))
    match = ("match", scene, "--reference", str(inputs / "reference.tif"), "--dem", dem, "-o", "out/points.geojson",
             "--report", "out/points.html", "--match-points")  # fmt: skip
    found.append(Case("match", (*match, "60"), (*match, "40"), (("out", "points"),)))
    ties = ("ties", *stereo, "--dem", str(inputs / "cartosat" / "dem.tif"), "-o", "out/ties.csv", "--match-points")
    found.append(Case("ties", (*ties, "60"), (*ties, "40"), (("out", "ties.csv"),)))
    folders = (("out/a", "a"), ("out/b", "b"), ("out", "mosaic"), ("out", "catalog"), ("out", "run"))
    for kind in ("VRT", "COG"):
        words = ("run", "--executor", "sequential", "--root", str(inputs.parent))
        new, old, *parts = ((*words, str(inputs / part / f"{age}_{kind}.yaml"))
                            for part, age in (("", "new"), ("", "old"), ("a", "new"), ("b", "new")))  # fmt: skip
        found.append(Case(f"run {kind}", new, old, folders, dict(zip("ab", parts, strict=True))))
    return found


def _pipeline(kind: str, kernel: str, part: str) -> str:
    """Return a pipeline file of two scenes that overlap, or in a folder below of one of them."""
    west, south, east, north = map(int, EXTENT)
    up = "../" if part else ""
    boxes = {"a": [west, south, east - 200, north], "b": [west + 300, south, east, north]}
    scenes = "".join(f"  - image: {up}{name}.tif\n    output: {{extent: {box}}}\n"
                     for name, box in boxes.items() if part in ("", name))  # fmt: skip
    return (
        f"scenes:\n{scenes}output: {up}../work/out\nmosaic: {{format: {kind}}}\n"
        f"defaults:\n  surface: {{dem: {up}dem.tif}}\n"
        f"  output: {{crs: 'EPSG:32636', resolution: 2.5, resampling: {kernel}, stac: true, "
        "acquired: '2005-08-03T08:12:31Z'}\n"
    )


def copy_inputs(folder: Path) -> Path:
    """Copy the sample data to a folder and put pipeline files there; return it."""
    shutil.copytree(SAMPLE, folder)
    for name in ("a", "b"):
        for ending in (".tif", "_RPC.TXT"):
            shutil.copyfile(SAMPLE / f"scene{ending}", folder / f"{name}{ending}")
    for part in ("", "a", "b"):
        (folder / part).mkdir(exist_ok=True)
        for kind in ("VRT", "COG"):
            for age, kernel in (("old", "nearest"), ("new", "bilinear")):
                (folder / part / f"{age}_{kind}.yaml").write_text(_pipeline(kind, kernel, part))
    return folder


def make_orthos(inputs: Path) -> None:
    """Make the two orthos that overlap, which mosaics are of."""
    west, south, east, north = map(int, EXTENT)
    for name, box in {"west": (west, south, east - 200, north), "east": (west + 300, south, east, north)}.items():
        words = ("rectify", str(inputs / "scene.tif"), "--dem", str(inputs / "dem.tif"), "-tr", "2.5", "-te")
        ended = run((*words, *map(str, box), "-o", str(inputs / name)), inputs)
        assert ended.code == 0, ended.said
        (inputs / name / "scene_ortho.tif").rename(inputs / f"{name}_ortho.tif")


# -- processes -------------------------------------------------------------------------------------------------------


@dataclass
class Ended:
    """How a command ended: its exit code (negative: the signal), what it said, how long it took."""

    code: int
    said: str
    seconds: float
    hung: bool = False


class Running:
    """A command in a session of its own, in `folder`; `prepare` is called in its process before it begins."""

    def __init__(self, words: Sequence[str], folder: Path, prepare: Callable[[], None] | None = None) -> None:
        self.begin = time.monotonic()
        self._reader, writer = os.pipe()
        self.pid = os.fork()
        if self.pid == 0:
            _command(words, folder, writer, prepare)
        os.close(writer)

    def signal(self, number: int, pid: int | None = None, group: bool = False) -> None:
        """Send a signal to the command, one of its workers, or all of them."""
        with contextlib.suppress(ProcessLookupError):
            (os.killpg if group else os.kill)(pid or self.pid, number)

    def workers(self) -> list[int]:
        """Return the processes that it has spawned to work."""
        found = []
        for entry in Path("/proc").iterdir():
            with contextlib.suppress(OSError, ValueError):
                if b"spawn_main" in (entry / "cmdline").read_bytes() and os.getsid(int(entry.name)) == self.pid:
                    found.append(int(entry.name))
        return found

    def end(self) -> Ended:
        """Wait until it and all that it has started are gone."""
        said, hung, limit = b"", False, time.monotonic() + PATIENCE
        while True:
            ready, _, _ = select.select([self._reader], [], [], max(0.0, limit - time.monotonic()))
            part = os.read(self._reader, 65536) if ready else b""
            said += part
            if not ready:
                hung = True
                self.signal(signal.SIGKILL, group=True)
            if not part:
                break
        os.close(self._reader)
        _, status = os.waitpid(self.pid, 0)
        code = os.waitstatus_to_exitcode(status)
        return Ended(code, said.decode(errors="replace"), time.monotonic() - self.begin, hung)


def _command(words: Sequence[str], folder: Path, writer: int, prepare: Callable[[], None] | None) -> None:
    """Be the command: never returns."""
    code = 1
    try:
        from ortho_pipeline.cli import program as cli

        os.setsid()
        os.chdir(folder)
        # A pipe and no file: a limit on the size of files would cut off what is said.
        os.dup2(writer, 1)
        os.dup2(writer, 2)
        os.close(writer)
        # A shell lets what it starts in the background ignore some of these, and nohup others.
        signal.signal(signal.SIGINT, signal.default_int_handler)
        for number in (signal.SIGHUP, signal.SIGTERM, signal.SIGQUIT):
            signal.signal(number, signal.SIG_DFL)
        signal.pthread_sigmask(signal.SIG_SETMASK, [])
        sys.argv = ["ortho", *words]
        if prepare is not None:
            prepare()
        cli.main()
        code = 0
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(end.code is not None)
    except KeyboardInterrupt:
        # Between the fork and the command's own beginning.
        code = 130
    except BaseException:
        os.write(2, traceback.format_exc().encode())
    finally:
        with contextlib.suppress(BaseException):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(code)


def run(words: Sequence[str], folder: Path, prepare: Callable[[], None] | None = None) -> Ended:
    """Run a command to its end."""
    return Running(words, folder, prepare).end()


def limit_files(size: int) -> Callable[[], None]:
    """Return what lets no file of a process grow beyond `size` bytes."""
    return lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))


def limit_memory(more: int) -> Callable[[], None]:
    """Return what lets the address space of a process grow by `more` bytes only."""

    def prepare() -> None:
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        limit = pages * resource.getpagesize() + more
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))

    return prepare


#: Calls that change a folder, through which every output goes; GDAL's own are reached by time.
_CALLS = ("replace", "unlink", "fsync", "open", "mkdir", "rmdir")


def at_calls(act: Callable[[int], None]) -> Callable[[], None]:
    """Return what does something at each call of the system that changes a folder, given its number from 1."""

    def prepare() -> None:
        count = 0

        def counted(function: Callable[..., object]) -> Callable[..., object]:
            def call(*given: object, **named: object) -> object:
                nonlocal count
                count += 1
                act(count)
                return function(*given, **named)

            return call

        for name in _CALLS:
            setattr(os, name, counted(getattr(os, name)))

    return prepare


def at_call(number: int, act: Callable[[], None]) -> Callable[[], None]:
    """Return what does something at the n-th of these calls."""
    return at_calls(lambda count: act() if count == number else None)


# -- what has to be true ---------------------------------------------------------------------------------------------


def content(folder: Path) -> Files:
    """Return the checksums of all files below a folder, without what a run says of itself; temporaries too."""
    found = {}
    for path in sorted(folder.rglob("*")):
        name = str(path.relative_to(folder))
        if path.is_file() and (".part" in name or not _OF_THE_RUN.search(name)):
            found[name] = hashlib.sha256(path.read_bytes()).hexdigest()
    return found


def untyped(ended: Ended) -> str | None:
    """Return what is wrong with how a command said that it failed."""
    if ended.hung:
        return "hangs"
    if "Traceback" in ended.said or "bug in ortho-pipeline" in ended.said:
        return f"untyped error: {ended.said[-300:]}"
    if ended.code == 1 and not ended.said.strip():
        return f"exit code 1 without a word: {ended.said[-300:]}"
    if ended.code < 0:
        return f"ended by signal {-ended.code}: {ended.said[-200:]}"
    return None


@dataclass
class Tally:
    """Tries and complaints of one kind of fault."""

    tries: int = 0
    outcomes: Counter[str] = field(default_factory=Counter)
    complaints: list[str] = field(default_factory=list)

    def add(self, outcome: str, complaints: Sequence[str]) -> None:
        """Note a try."""
        self.tries += 1
        for text in complaints:
            print(f"  {text}", flush=True)
        self.outcomes[outcome] += 1
        self.complaints += complaints


class Attack:
    """A scratch folder, the cases, and what their outputs are when nothing disturbs them."""

    def __init__(self, scratch: Path, seed: int = 1, only: str = "", again: int = 4) -> None:
        self.scratch, self.random, self.again = scratch, random.Random(seed), again
        self.inputs = copy_inputs(scratch / "inputs")
        self.work, self.out = scratch / "work", scratch / "work" / "out"
        self.cases = [case for case in cases(self.inputs) if only in case.name]
        if any(case.name.startswith("mosaic") for case in self.cases):
            make_orthos(self.inputs)
        self.tallies: dict[str, Tally] = {}
        self._kept: dict[tuple[str, ...], tuple[Path, Files, float]] = {}
        self._calls: dict[tuple[str, ...], int] = {}

    # -- sets of files -----------------------------------------------------------------------------------------------

    def whole(self, words: tuple[str, ...]) -> tuple[Path, Files, float]:
        """Return a copy of the outputs of an undisturbed command, their checksums, and its seconds."""
        if words not in self._kept:
            self.clear()
            with mmap.mmap(-1, 8) as shared:  # the command is another process
                ended = run(words, self.work, at_calls(lambda count: struct.pack_into("<q", shared, 0, count)))
                self._calls[words] = struct.unpack_from("<q", shared)[0]
            assert ended.code == 0, (words, ended.said)
            kept = self.scratch / f"kept{len(self._kept)}"
            shutil.copytree(self.out, kept)
            self._kept[words] = kept, content(kept), ended.seconds
        return self._kept[words]

    def clear(self) -> None:
        """Empty the folder of the work."""
        shutil.rmtree(self.work, ignore_errors=True)
        self.work.mkdir()

    def start_from(self, case: Case, old: bool) -> Files:
        """Put the outputs of the run before into place, or nothing; return their checksums."""
        for words in (case.words, *case.parts.values()):
            self.whole(words)
        self.clear()
        if not old:
            return {}
        kept, files, _ = self.whole(case.before)
        shutil.rmtree(self.work)
        shutil.copytree(kept, self.out)
        return files

    def one_set(self, case: Case, before: Files, new: Files, now: Files) -> bool:
        """Tell whether each set of a case is one of the two whole ones."""
        partly = self._of_what_was_made(case, before)
        for folder, name in case.names:
            # A run has several sets in its folder, which begin with their names.
            start = "" if len(case.names) == 1 else f"{name}." if folder == "out" else f"{name}/"

            def part(files: Files, start: str = start) -> Files:
                return {path: value for path, value in files.items() if path.startswith(start)}

            # A mosaic goes before its scenes are made again: a VRT would show new orthos at the old place.
            gone = name == "mosaic" and not part(now)
            if not gone and part(now) not in (
                part(before),
                part(new),
                *([part(partly[name])] if name in partly else []),
            ):
                return False
        return True

    def _of_what_was_made(self, case: Case, before: Files) -> dict[str, Files]:
        """Return what the mosaic and the catalog of a run have to hold by what it says that it made of its scenes."""
        try:
            told = json.loads((self.out / "run.json").read_text())
        except (OSError, ValueError):
            return {}
        made = [scene["name"] for scene in told["scenes"] if scene["status"] != "failed"]
        if not case.parts or len(made) != 1:
            return {}
        files = self._kept[case.parts[made[0]]][1]
        return {"catalog": files, "mosaic": before if "error" in told["mosaic"] else files}

    def recover(self, case: Case) -> None:
        """Do what the next command does before anything else."""
        from ortho_pipeline.files import together

        records = [("out/.run", f"{one}.json") for one in "ab"]
        for folder, name in (*case.names, ("out", "catalog.json"), ("out", "run.json"), *records):
            if (self.work / folder).is_dir():
                with together(self.work / folder, name):
                    pass

    def judge(self, case: Case, before: Files, ended: Ended, *, killed: bool, again: bool) -> tuple[str, list[str]]:
        """Return what became of a disturbed command, and what is wrong with that."""
        new = self.whole_new(case)
        wrong = []
        now = content(self.out)
        if "the report could not be made" in ended.said and ended.code == 3:
            # The other outputs are complete, and no report of an earlier command is beside them.
            new = {name: value for name, value in new.items() if name in now or not _OF_THE_REPORT.search(name)}
        if killed:
            if ended.hung:
                wrong.append("hangs")
            self.recover(case)
            now = content(self.out)
        elif ended.code == 0 and now != new:
            wrong.append("exit code 0, but not the whole new set")
        else:
            wrong += [text for text in [untyped(ended)] if text is not None]
        # What is left among the records of a run goes with the next one.
        left = [name for name in now if ".part" in name and not name.startswith(".run/")]
        wrong += [f"left: {', '.join(left)}"] if left else []
        if not self.one_set(case, before, new, {name: now[name] for name in now if ".part" not in name}):
            wrong.append(f"broken or mixed set: {sorted(set(now.items()) - set(new.items()) - set(before.items()))}")
        outcome = "new" if now == new else "old" if now == before else "parts"
        if again:
            next_one = run(case.words, self.work)
            left = [name for name in content(self.out) if ".part" in name]
            wrong += [f"the next run leaves: {', '.join(left)}"] if left else []
            if next_one.code != 0 or content(self.out) != self.whole_new(case):
                differs = sorted(set(content(self.out).items()) ^ set(self.whole_new(case).items()))
                wrong.append(f"the next run ends with {next_one.code}: {next_one.said[-300:]} {differs[:6]}")
        return outcome, [f"{case.name}: {text}" for text in wrong]

    def whole_new(self, case: Case) -> Files:
        """Return the checksums of the outputs of a case."""
        return self._kept[case.words][1]

    def tally(self, kind: str) -> Tally:
        """Return the tally of a kind of fault."""
        return self.tallies.setdefault(kind, Tally())

    # -- faults ------------------------------------------------------------------------------------------------------

    def limits(self, count: int) -> None:
        """Limit the size of files, from a few bytes to that of the largest one."""
        for case, old in self._turns(count):
            kept, _, _ = self.whole(case.words)
            before = self.start_from(case, old)
            sizes = [path.stat().st_size for path in kept.rglob("*") if path.is_file()]
            # Every file is cut off somewhere, the large ones more often.
            size = int(self.random.choice([*sizes, max(sizes), max(sizes)]) * self.random.uniform(0.02, 1.0))
            ended = run(case.words, self.work, limit_files(max(100, size)))
            outcome, wrong = self.judge(case, before, ended, killed=False, again=self.random.random() < 0.1)
            self.tally("write limits").add(outcome, [f"{text} [limit {size} bytes, old {old}]" for text in wrong])

    def kills(self, count: int) -> None:
        """Kill commands at random times, and at random calls of the system that change a folder."""
        kinds = ("at a call", "KILL", "TERM", "INT", "HUP")
        for turn, (case, old) in enumerate(self._turns(count)):
            _, _, seconds = self.whole(case.words)
            before = self.start_from(case, old)
            kind = kinds[turn % len(kinds)]
            delay = self.random.uniform(0.0, 1.1 * seconds)
            if kind == "at a call":
                delay = float(self.random.randint(1, self._calls[case.words] + 2))
                command = Running(case.words, self.work, at_call(int(delay), _die))
            else:
                command = Running(case.words, self.work)
                time.sleep(delay)
                command.signal(getattr(signal, f"SIG{kind}"))
            ended = command.end()
            if kind in ("TERM", "INT", "HUP"):
                # These clean up by themselves; before Python's handlers are there, they end the process as any other.
                early = ended.code < 0 and not list(self.work.rglob("*.part*"))
                by_signal = early or ended.code in (129, 130, 143)
                outcome, wrong = self.judge(case, before, ended, killed=by_signal, again=turn % self.again == 0)
                left = [] if early else [path.name for path in self.work.rglob(".*.part*")]
                wrong += [f"{case.name}: {kind} leaves {left}"] if left else []
            else:
                outcome, wrong = self.judge(case, before, ended, killed=ended.code != 0, again=turn % self.again == 0)
            self.tally(f"killed {kind}").add(outcome, [f"{text} [{kind} {delay:.3f}, old {old}]" for text in wrong])

    def kills_of_workers(self, count: int) -> None:
        """Kill the parent, a worker, or all processes of `ortho run --executor processes`."""
        case = next((case for case in self.cases if case.name == "run VRT"), None)
        if case is None:
            return
        words = ("run", "--executor", "processes", "--workers", "2", *case.words[3:])
        for turn in range(count):
            self.whole(case.words)
            before = self.start_from(case, old=bool(turn % 2))
            target = ("parent KILL", "worker KILL", "group KILL", "group TERM", "group INT", "parent TERM")[turn % 6]
            command, number = Running(words, self.work), getattr(signal, f"SIG{target.split()[1]}")
            until = time.monotonic() + 30
            while time.monotonic() < until and not command.workers():
                time.sleep(0.02)
            # Workers take their time to load what they need.
            time.sleep(self.random.uniform(0.0, 8.0))
            if target.startswith("worker"):
                for pid in command.workers()[:1]:
                    command.signal(number, pid)
            else:
                command.signal(number, group=target.startswith("group"))
            ended = command.end()
            outcome, wrong = self.judge(case, before, ended, killed=ended.code != 0, again=True)
            if target.startswith("worker") and ended.code != 0:
                wrong.append(f"a worker that is killed ends the run with {ended.code}: {ended.said[-300:]}")
            self.tally("run --executor processes").add(outcome, [f"{text} [{target}]" for text in wrong])

    def full_disks(self, count: int) -> None:
        """Write to a file system that is too small."""
        for case, old in self._turns(count):
            kept, _, _ = self.whole(case.words)
            before = self.start_from(case, old)
            sizes = [sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
                     for folder in (kept, self.work)]  # fmt: skip
            room = int(sizes[1] * 1.1 + 120_000 + sizes[0] * self.random.uniform(0.0, 2.2))
            with _small_disk(self.work, room):
                ended = run(case.words, self.work)
                outcome, wrong = self.judge(case, before, ended, killed=False, again=False)
            self.tally("full file system").add(outcome, [f"{text} [{room} bytes]" for text in wrong])

    def memory(self, count: int) -> None:
        """Let a command have little memory; GDAL and NumPy say so in their ways, or end the process."""
        for case, old in self._turns(count):
            self.whole(case.words)
            before = self.start_from(case, old)
            more = int(2 ** self.random.uniform(20, 31))
            ended = run(case.words, self.work, limit_memory(more))
            outcome, wrong = self.judge(case, before, ended, killed=ended.code < 0, again=False)
            if ended.code < 0:
                outcome = "killed by the system"
            self.tally("memory limits").add(outcome, [f"{text} [{more >> 20} MB]" for text in wrong])

    def changes(self, count: int) -> None:
        """Change an input while a command runs: its outputs are of what was there, or there is an error."""
        chosen = [case for case in self.cases if case.name.startswith("rectify")]
        for turn in range(count if chosen else 0):
            case = chosen[turn % len(chosen)]
            self.whole(case.words)
            before = self.start_from(case, old=bool(turn % 2))
            victim = self.inputs / self.random.choice(["scene.tif", "dem.tif", "scene_RPC.TXT", "gcps.geojson"])
            change = at_call(self.random.randint(1, 60), lambda victim=victim: _touch(victim))
            ended = run(case.words, self.work, change)
            outcome, wrong = self.judge(case, before, ended, killed=False, again=False)
            if ended.code not in (0, 2):
                wrong.append(f"{case.name}: exit code {ended.code} when {victim.name} changed")
            self.tally("changed sources").add(outcome, wrong)

    def _turns(self, count: int) -> Iterator[tuple[Case, bool]]:
        """Yield cases in turn, each with and without outputs of a run before."""
        for turn in range(count):
            yield self.cases[turn % len(self.cases)], bool(turn // len(self.cases) % 2 == 0)


def _die() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def _touch(path: Path) -> None:
    # The content stays: what is tested is that the change is noticed.
    os.utime(path, ns=(time.time_ns(), time.time_ns()))


@contextlib.contextmanager
def _small_disk(folder: Path, size: int) -> Iterator[None]:
    """Put a file system of `size` bytes in place of a folder, with its content."""
    aside = folder.with_name(f"{folder.name}.aside")
    folder.rename(aside)
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)]
    subprocess.run(mount, check=True, capture_output=True)
    try:
        shutil.copytree(aside, folder, dirs_exist_ok=True)
        yield
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)
        shutil.rmtree(aside)


def may_mount() -> bool:
    """Tell whether a small file system can be made here (as root, outside of most containers)."""
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / "disk"
        place.mkdir()
        try:
            with _small_disk(place, 100_000):
                return True
        except (OSError, subprocess.CalledProcessError):
            return False


def load() -> None:
    """Load what commands use, so that each forked process has it."""

    import ortho_pipeline.batch.runner
    import ortho_pipeline.commands.bands
    import ortho_pipeline.commands.block
    import ortho_pipeline.commands.control.command
    import ortho_pipeline.commands.control.ties
    import ortho_pipeline.commands.mosaic.assembly
    import ortho_pipeline.commands.rectification
    import ortho_pipeline.warp.lattice_engine  # noqa: F401
    from ortho_pipeline import host

    host.Host.discover()


def main() -> int:
    """Attack, print what happened, and return 1 if something was wrong."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, count in {"limits": 400, "kills": 300, "workers": 24, "disks": 60, "memory": 60, "changes": 24}.items():
        parser.add_argument(f"--{name}", type=int, default=count, metavar="N")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="", help="Part of the name of a case.")
    parser.add_argument("--again", type=int, default=4, metavar="N", help="The next run follows each N-th kill.")
    given = parser.parse_args()
    load()
    begin = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="faults") as folder:
        attack = Attack(Path(folder).resolve(), given.seed, given.only, given.again)
        attack.limits(given.limits)
        attack.kills(given.kills)
        attack.kills_of_workers(given.workers)
        if given.disks and may_mount():
            attack.full_disks(given.disks)
        elif given.disks:
            print("full file system: skipped, because no file system may be mounted here")
        attack.memory(given.memory)
        attack.changes(given.changes)
    for kind, tally in attack.tallies.items():
        print(f"{kind}: {tally.tries} tries, {dict(tally.outcomes)}, {len(tally.complaints)} complaints")
    print(json.dumps({"seconds": round(time.monotonic() - begin), "seed": given.seed}))
    return int(any(tally.complaints for tally in attack.tallies.values()))


if __name__ == "__main__":
    sys.exit(main())
