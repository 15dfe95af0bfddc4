"""Mutants of the packages by the operators of cosmic-ray, drawn at random by line."""

from __future__ import annotations

import ast
import random
import warnings
from collections import defaultdict
from dataclasses import dataclass
from difflib import unified_diff
from functools import cache
from itertools import count
from pathlib import Path

from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.mutating import mutate_code
from cosmic_ray.plugins import get_operator, operator_names

_LEFT_OUT = ("core/VariableReplacer", "core/VariableInserter")
"""They draw numbers of their own, and ask which variable."""
_NO_MATTER = ("TYPE_CHECKING", "@compiled(", "@inner_kernel(")
"""Lines that hold no behaviour: imports for the type checker, and how fast a kernel is."""

_NEVER_CHANGED = {"name", "newline", "string", "endmarker"}


@dataclass(frozen=True)
class Mutant:
    """The n-th place in a file where an operator can change something; `line` counts from 1."""

    file: str
    line: int
    operator: str
    place: int

    def text(self, root: Path) -> str:
        """Return the text of the whole file with the change."""
        changed = mutate_code((root / self.file).read_text(), get_operator(self.operator)(), self.place)
        assert changed is not None, self
        return str(changed)

    def difference(self, root: Path) -> str:
        """Return the lines that change, before and after."""
        before, after = _lines(root / self.file), self.text(root).splitlines()
        lines = [line for line in unified_diff(before, after, n=0, lineterm="") if line[:3] not in ("---", "+++")]
        return "\n".join(f"       {line}" for line in lines if not line.startswith("@@"))


def draw(root: Path, packages: tuple[str, ...], number: int, seed: int) -> list[Mutant]:
    """Return mutants in random order: a line, one of the operators that change it, one of the places there."""
    files = [path.relative_to(root).as_posix() for package in packages for path in (root / package).rglob("*.py")]
    lines = [(file, line) for file in sorted(files) for line in range(1, len(_lines(root / file)) + 1)]
    rng, drawn = random.Random(seed), []
    for file, line in rng.sample(lines, len(lines)):
        if len(drawn) == number:
            break
        if families := _mutants(root, file).get(line):
            mutant = rng.choice(families[rng.choice(sorted(families))])
            if _changes(root, mutant):
                drawn.append(mutant)
    return drawn


@cache
def _mutants(root: Path, file: str) -> dict[int, dict[str, list[Mutant]]]:
    """Return the mutants of a file by line, and by operator without what it changes into what."""
    lines = _lines(root / file)
    nodes = [node for node in ast_nodes(get_ast("\n".join(lines))) if node.type not in _NEVER_CHANGED]
    mutants: dict[int, dict[str, list[Mutant]]] = defaultdict(lambda: defaultdict(list))
    for operator in operator_names():
        if operator in _LEFT_OUT:
            continue
        change, places = get_operator(operator)(), count()
        for node in nodes:
            for (line, _), _ in change.mutation_positions(node):
                place = next(places)
                if not any(word in lines[line - 1] for word in _NO_MATTER):
                    mutants[line][operator.partition("_")[0]].append(Mutant(file, line, operator, place))
    return mutants


def _lines(path: Path) -> list[str]:
    return path.read_text().splitlines()


def _changes(root: Path, mutant: Mutant) -> bool:
    """Return whether a mutant is a program, and another one but for annotations and the `*` of signatures."""
    try:
        changed = _behaviour(mutant.text(root))
    except SyntaxError:
        return False
    return changed != _behaviour((root / mutant.file).read_text())


@cache
def _behaviour(text: str) -> str:
    with warnings.catch_warnings(action="ignore", category=SyntaxWarning):
        tree = ast.parse(text)
    for node in ast.walk(tree):
        for field in ("annotation", "returns"):
            if getattr(node, field, None) is not None:
                setattr(node, field, ast.Constant(None))
        if isinstance(node, ast.arguments):
            node.args = [*node.posonlyargs, *node.args, *node.kwonlyargs]
            node.posonlyargs = node.kwonlyargs = []
    return ast.dump(tree)
