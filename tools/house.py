"""Measure the structure of the code: `python tools/house.py [FOLDER OF THE REPOSITORY]`.

Prints, of the host (`ortho_pipeline`) and of the plugins:

- statements of the syntax tree by room, docstrings not counted, and the lengths of functions in statements,
- pairs of rooms of which one imports the other,
- circles of imports between modules: those at the top of files, and those that deferred imports close,
- public class names that mean several things,
- names of other packages that begin with an underscore, imported or reached as attributes.

Nothing is imported; the files are read as text.
"""

from __future__ import annotations

import ast
import sys
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path

import numpy as np

HOST = "ortho_pipeline"
_FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)
_DOCUMENTED = (ast.Module, ast.ClassDef, *_FUNCTIONS)


class House:
    """The modules of a checkout.

    Parameters
    ----------
    root : Path
        Folder that holds `ortho_pipeline` and `plugins`.
    """

    def __init__(self, root: Path) -> None:
        files = [(path, root) for path in sorted((root / HOST).rglob("*.py"))]
        files += [(path, root / "plugins") for path in sorted((root / "plugins").rglob("*.py"))]
        self.trees = {module_of(path, start): ast.parse(path.read_text(encoding="utf-8")) for path, start in files}
        self.packages = {name.partition(".")[0] for name in self.trees}

    def statements(self) -> Counter[str]:
        """Return how many statements each room has."""
        count: Counter[str] = Counter()
        for module, tree in self.trees.items():
            count[room_of(module)] += statements(tree)
        return count

    def function_lengths(self) -> list[int]:
        """Return how many statements each function has, those of functions inside included."""
        return [
            statements(node) - 1
            for tree in self.trees.values()
            for node in ast.walk(tree)
            if isinstance(node, _FUNCTIONS)
        ]

    def imports(self, module: str) -> Iterator[tuple[str, bool]]:
        """Yield each module of this checkout that a module imports, and whether it does so at the top of its file."""
        tree = self.trees[module]
        for node in ast.walk(tree):
            names: list[str] = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                inside = (f"{node.module}.{alias.name}" for alias in node.names)
                names = [name if name in self.trees else str(node.module) for name in inside]
            for name in names:
                if name in self.trees and name != module:
                    yield name, node in tree.body

    def room_pairs(self) -> set[tuple[str, str]]:
        """Return the pairs (importing room, imported room) of the host."""
        pairs = {(room_of(one), room_of(other)) for one in self.trees for other, _ in self.imports(one)}
        return {(a, b) for a, b in pairs if a != b and a.startswith(HOST) and b.startswith(HOST)}

    def circles(self, *, deferred: bool) -> list[list[str]]:
        """Return the groups of modules that import each other; with or without imports inside functions."""
        graph = {module: {name for name, at_top in self.imports(module) if at_top or deferred} for module in self.trees}
        return [group for group in strongly_connected(graph) if len(group) > 1]

    def shared_class_names(self) -> dict[str, list[str]]:
        """Return public class names that several modules define, with the modules."""
        where: defaultdict[str, list[str]] = defaultdict(list)
        for module, tree in self.trees.items():
            for node in ast.walk(tree):
                if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                    where[node.name].append(module)
        return {name: modules for name, modules in sorted(where.items()) if len(modules) > 1}

    def private_names(self) -> list[tuple[str, int, str]]:
        """Return (module, line, name) of private names of other packages.

        An attribute belongs to others if its name is defined nowhere in this checkout, whatever it is an attribute of.
        """
        own = {name for tree in self.trees.values() for name in defined(tree)}
        found = set()
        for module, tree in self.trees.items():
            for node in ast.walk(tree):
                if isinstance(node, ast.Import):
                    names = [alias.name for alias in node.names]
                elif isinstance(node, ast.ImportFrom) and node.module != "__future__":
                    names = [f"{node.module}.{alias.name}" for alias in node.names]
                elif isinstance(node, ast.Attribute) and is_private(node.attr) and node.attr not in own:
                    found.add((module, node.lineno, ast.unparse(node)))
                    continue
                else:
                    continue
                found |= {
                    (module, node.lineno, name)
                    for name in names
                    if name.partition(".")[0] not in self.packages and is_private(name)
                }
        return sorted(found)


def module_of(path: Path, start: Path) -> str:
    """Return the dotted name of a file; that of a package for its `__init__.py`."""
    parts = path.relative_to(start).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def room_of(module: str) -> str:
    """Return the room of a module: the first folder of the host, or the package of a plugin."""
    parts = module.split(".")
    return ".".join(parts[:2]) if parts[0] == HOST else parts[0]


def statements(tree: ast.AST) -> int:
    """Count the statements of a tree without its docstrings."""
    nodes = list(ast.walk(tree))
    docstrings = sum(
        isinstance(node, _DOCUMENTED) and ast.get_docstring(node, clean=False) is not None for node in nodes
    )
    return sum(isinstance(node, ast.stmt) for node in nodes) - docstrings


def defined(tree: ast.AST) -> Iterator[str]:
    """Yield the names of functions, classes, variables and attributes of `self` that a tree defines."""
    for node in ast.walk(tree):
        match node:
            case ast.FunctionDef() | ast.AsyncFunctionDef() | ast.ClassDef():
                yield node.name
            case ast.Name(ctx=ast.Store()):
                yield node.id
            case ast.Attribute(ctx=ast.Store(), value=ast.Name(id="self")):
                yield node.attr


def is_private(dotted: str) -> bool:
    """Say whether a part of a dotted name begins with one underscore."""
    return any(part.startswith("_") and not part.startswith("__") for part in dotted.split("."))


def strongly_connected(graph: dict[str, set[str]]) -> list[list[str]]:
    """Return the groups of nodes that reach each other (Kosaraju), sorted."""
    order: list[str] = []
    seen: set[str] = set()

    def visit(start: str, edges: dict[str, set[str]], into: list[str]) -> None:
        stack = [(start, iter(sorted(edges[start])))]
        seen.add(start)
        while stack:
            node, following = stack[-1]
            for one in following:
                if one not in seen:
                    seen.add(one)
                    stack.append((one, iter(sorted(edges[one]))))
                    break
            else:
                stack.pop()
                into.append(node)

    for node in sorted(graph):
        if node not in seen:
            visit(node, graph, order)
    backwards: dict[str, set[str]] = {node: set() for node in graph}
    for node, targets in graph.items():
        for target in targets:
            backwards[target].add(node)
    seen.clear()
    groups = []
    for node in reversed(order):
        if node not in seen:
            group: list[str] = []
            visit(node, backwards, group)
            groups.append(sorted(group))
    return sorted(groups)


def main(root: Path) -> None:
    """Print all measures of a checkout."""
    house = House(root)
    count = house.statements()
    host = sum(number for room, number in count.items() if room.startswith(HOST))
    print(f"statements: host {host:,}, plugins {sum(count.values()) - host:,}")
    for room, number in sorted(count.items()):
        print(f"  {room:32} {number:6,}")
    lengths = house.function_lengths()
    median, most = np.percentile(lengths, [50, 95])
    print(f"functions: {len(lengths):,}, median {median:.0f} statements, 95 % {most:.0f}")
    pairs = house.room_pairs()
    print(f"pairs of rooms: {len(pairs)}")
    at_top, all_circles = house.circles(deferred=False), house.circles(deferred=True)
    print(f"circles of imports at the top of files: {len(at_top)}; with deferred imports: {len(all_circles)}")
    for group in all_circles:
        print(f"  {', '.join(group)}")
    shared = house.shared_class_names()
    print(f"public class names with several meanings: {len(shared)}")
    for name, modules in shared.items():
        print(f"  {name}: {', '.join(modules)}")
    private = house.private_names()
    print(f"private names of other packages: {len(private)}")
    for module, line, name in private:
        print(f"  {module}:{line} {name}")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).resolve().parent.parent)
