"""Which test enters which function of the host: a plugin of pytest that records it, and the records.

`tools/mutants.py` uses both. Functions are named by path and qualified name.
"""

from __future__ import annotations

import ast
import hashlib
import json
import os
import sys
import threading
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path
from typing import Any

HOST = "ortho_pipeline"
#: Environment variable: the folder of the records.
FOLDER = "ENTERED"
FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)
#: Decorators of compiled functions.
COMPILED = "compiled", "inlined"


class Recorder:
    """Notes the functions of the host that are entered in each phase of each test, compiled ones included."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.entered = folder, set[Any]()
        self.files: dict[str, dict[str, Any]] = defaultdict(lambda: {"setup": set(), "tests": {}})

    def called(self, frame: Any, *_: object) -> None:
        """Note a call, as `sys.settrace` has it; it returns no function for the lines, which would take longer."""
        self.entered.add(frame.f_code)
        if frame.f_code.co_name == "__call__" and frame.f_code.co_qualname == "Kernel.__call__":
            self.entered.add(frame.f_locals["self"].py_func.__code__)

    def pytest_runtest_logstart(self) -> None:
        """Begin with a test."""
        self._watch()

    def pytest_runtest_logreport(self, report: Any) -> None:
        """Keep what a phase of a test has entered."""
        sys.settrace(None)
        file = self.files[report.nodeid.partition("::")[0]]
        # A copy at once: threads of the test may still run.
        seen = {_key(code) for code in list(self.entered) if f"/{HOST}/" in code.co_filename}
        if report.when == "setup":
            file["setup"] |= seen
        elif report.when == "call" and report.passed:
            file["tests"][report.nodeid] = [round(report.duration, 2), sorted(seen)]
        self._watch()

    def pytest_sessionfinish(self) -> None:
        """Write the records."""
        sys.settrace(None)
        self.folder.mkdir(parents=True, exist_ok=True)
        for name, file in self.files.items():
            found = {"digest": _digest(Path(name)), "setup": sorted(file["setup"]), "tests": file["tests"]}
            record_of(self.folder, name).write_text(json.dumps(found))

    def _watch(self) -> None:
        self.entered.clear()
        sys.settrace(self.called)
        threading.settrace(self.called)


def pytest_configure(config: Any) -> None:
    """Record if a folder for it is named."""
    if FOLDER in os.environ:
        config.pluginmanager.register(Recorder(Path(os.environ[FOLDER])))


def _key(code: Any) -> str:
    return f"{HOST}/{code.co_filename.rpartition(f'/{HOST}/')[2]}:{code.co_qualname}"


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def record_of(folder: Path, test_file: str) -> Path:
    """Return the record of a file of tests."""
    return folder / f"{test_file.replace('/', '+')}.json"


def is_recorded(folder: Path, root: Path, test_file: str) -> bool:
    """Return whether a file of tests has a record and is what it was then."""
    record = record_of(folder, test_file)
    return record.is_file() and json.loads(record.read_text())["digest"] == _digest(root / test_file)


class Entered:
    """The records of a checkout.

    Attributes
    ----------
    seconds : dict of str to float
        How long each test takes.
    """

    def __init__(self, folder: Path, root: Path) -> None:
        self.seconds: dict[str, float] = {}
        self._tests: dict[str, set[str]] = defaultdict(set)
        self._users: dict[str, set[str]] = defaultdict(set)
        for path in folder.glob("*.json"):
            file = json.loads(path.read_text())
            for test, (seconds, functions) in file["tests"].items():
                self.seconds[test] = seconds
                for function in {*functions, *file["setup"]}:
                    self._tests[function].add(test)
        self._imported: dict[str, set[str]] = {}
        self._compiled: set[str] = set()
        for path in (root / HOST).rglob("*.py"):
            tree, name = ast.parse(path.read_bytes()), str(path.relative_to(root))
            self._imported[name] = _imported(tree)
            self._note_users(tree, name, "")

    def _note_users(self, node: ast.AST, path: str, function: str) -> None:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, (ast.Name, ast.Attribute)):
                self._users[child.id if isinstance(child, ast.Name) else child.attr].add(f"{path}:{function}")
            within = inside(node, child, function)
            if isinstance(child, FUNCTIONS) and any(ast.unparse(mark) in COMPILED for mark in child.decorator_list):
                self._compiled.add(f"{path}:{within}")
            # What an assignment uses is used under the name that it assigns.
            for name in assigned(node, child) or ("",):
                self._note_users(child, path, f"{within}.{name}".strip("."))

    def by(self, function: str, names: Iterable[str]) -> set[str]:
        """Return the tests that enter a function; if none does, or it is compiled, those of what uses its name too.

        What a module or class assigns to `names` has the tests of what uses these. Compiled functions call each other,
        and cached ones are not called, without a record.
        """
        found, seen = set(self._tests.get(function, ())), set[tuple[str, str]]()
        left = {(function.partition(":")[0], name) for name in names} if self._goes_on(function) else set()
        while left:
            seen |= left
            users = {user for path, name in left for user in self._users[name] if self._sees(user, path)}
            found |= {test for user in users for test in self._tests.get(user, ())}
            users = {user for user in users if self._goes_on(user)}
            left = {(user.partition(":")[0], user.rpartition(":")[2].rpartition(".")[2]) for user in users} - seen
        return found

    def _goes_on(self, function: str) -> bool:
        """Return whether the callers of a function have tests that its own record lacks."""
        return function in self._compiled or not self._tests.get(function)

    def _sees(self, user: str, path: str) -> bool:
        """Return whether a function can mean a name of a module."""
        own = user.partition(":")[0]
        return (
            own == path or path.removesuffix(".py").removesuffix("/__init__").replace("/", ".") in self._imported[own]
        )


def _imported(tree: ast.AST) -> set[str]:
    """Return the modules that a module imports, or names from."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found |= {str(node.module), *(f"{node.module}.{alias.name}" for alias in node.names)}
    return found


def inside(node: ast.AST, child: ast.AST, name: str) -> str:
    """Return the qualified name within `child` of a node whose own is `name`."""
    if not isinstance(child, (*FUNCTIONS, ast.ClassDef)):
        return name
    return f"{name}.<locals>.{child.name}" if isinstance(node, FUNCTIONS) else f"{name}.{child.name}".lstrip(".")


def assigned(node: ast.AST, child: ast.AST) -> tuple[str, ...]:
    """Return the names that a module or class assigns in one of its statements."""
    if not isinstance(node, (ast.Module, ast.ClassDef)) or not isinstance(child, (ast.Assign, ast.AnnAssign)):
        return ()
    targets = child.targets if isinstance(child, ast.Assign) else [child.target]
    return tuple(name.id for target in targets for name in ast.walk(target) if isinstance(name, ast.Name))
