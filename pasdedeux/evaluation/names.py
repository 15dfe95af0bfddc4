"""Names of methods and metrics in words, for readers who do not know the code."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterable
from functools import cache
from importlib import resources

_WORDS = tomllib.loads(resources.files("pasdedeux.evaluation").joinpath("words.toml").read_text(encoding="utf-8"))


def in_words(name: str) -> str:
    """Return a method's or metric's name in words; unknown names are split into words.

    >>> in_words("hand_contact_drift_p95"), in_words("cartesian_repaired"), in_words("new_score")
    ('drift of hands and feet in contact, 95 %', 'Cartesian, repaired', 'new score')
    """
    base, *endings = _parts(name)
    words = known[0] if (known := _known(base)) else re.sub(r"(?<=[a-z0-9])_(?=[a-z0-9])", " ", base)
    return "".join([words, *endings])


def part_in_words(part: str) -> str:
    """Return, in words, the part of the data that a score is over.

    >>> part_in_words("held_out"), part_in_words("cross_scale test")
    ('held-out takes', 'cross scale test')
    """
    return str(_WORDS["parts"].get(part, part.replace("_", " ")))


def meanings(names: Iterable[str]) -> tuple[tuple[str, str, str], ...]:
    """Return name, words and a sentence for each of these names that is known, sorted."""
    bases = sorted({_parts(name)[0] for name in names})
    return tuple((base, *known) for base in bases if (known := _known(base)) is not None)


def base_name(name: str) -> str:
    """Return a name without its known endings.

    >>> base_name("cartesian_repaired"), base_name("ic_repaired")
    ('cartesian', 'ic_repaired')
    """
    return _parts(name)[0]


@cache
def known_methods() -> tuple[str, ...]:
    """Return the names of the methods that have words, in their order, where methods of a topic are neighbours."""
    return tuple(_WORDS["methods"])


def is_bound(method: str) -> bool:
    """Tell whether a method knows the ground truth, so that it is a bound and not an answer."""
    return method in _WORDS["bounds"]


def better_sign(metric: str) -> int:
    """Return 1 where larger values of a metric are better, -1 where smaller are, 0 where that is not known."""
    _, _, better = _metrics().get(_parts(metric)[0], ("", "", ""))
    return {"larger": 1, "smaller": -1}.get(better, 0)


@cache
def _metrics() -> dict[str, tuple[str, str, str]]:
    """Return words, a sentence and the better direction of each metric; of several figures, those of the first."""
    from pasdedeux.augmentation import quality  # imported late: commands that only look need no science
    from pasdedeux.sampling import diagnostics

    declared: dict[str, tuple[str, str, str]] = {}
    for figure in (*quality.FIGURES.values(), *diagnostics.FIGURES.values()):
        sentence = figure.meaning[0].lower() + figure.meaning[1:]
        declared.setdefault(_without_ending(figure.metric)[0], (figure.words, sentence, figure.better))
    metrics = _WORDS["metrics"].items()
    return declared | {name: (*words, better) for better, named in metrics for name, words in named.items()}


def _known(base: str) -> tuple[str, str] | None:
    if base in _metrics():
        words, sentence, better = _metrics()[base]
        return words, f"{sentence}; {better} is better" if better else sentence
    words, sentence = _WORDS["methods"].get(base, ("", ""))
    return (words, sentence) if words else None


def _parts(name: str) -> list[str]:
    """Return a name without its endings, then the endings in words; a name that is not known keeps its endings."""
    base, words = _without_ending(name)
    if _known(name) or not words:
        return [name]
    first, *more = _parts(base)
    return [first, *more, words] if _known(first) else [name]


def _without_ending(name: str) -> tuple[str, str]:
    """Return a name without its last ending, and that ending in words; empty where it has none."""
    ending = next((ending for ending in _WORDS["endings"] if name.endswith(f"_{ending}")), "")
    return (name.removesuffix(f"_{ending}"), _WORDS["endings"][ending]) if ending else (name, "")
