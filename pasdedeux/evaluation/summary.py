"""What was built, from what, and is it good: the top of the report, the dataset card and the console's last lines."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from pasdedeux.evaluation.verdicts import verdict_words
from pasdedeux.verdict import Verdict

_MAX_SKIPPED = 8
"""Sentences on what was skipped among the last lines of the console, at most; the report and the card have all."""
_MAX_NAMED = 6
"""Things that share a sentence and are named in it, at most."""


@dataclass(frozen=True)
class Credit:
    """A source that the data was made from."""

    name: str
    licence: str
    credit: str


@dataclass(frozen=True)
class Made:
    """How much there is of one thing: its name in the plural, number, seconds of motion (NaN where none), bytes."""

    thing: str
    count: int
    seconds: float
    num_bytes: int

    def __str__(self) -> str:
        """Return it in words.

        >>> str(Made("takes", 1200, 75.0, 1_500_000))
        '1,200 takes (1 min 15 s, 1.5 MB)'
        """
        return f"{self.count:,} {self.noun} ({self.extent})"

    @property
    def noun(self) -> str:
        """Its name for its number."""
        return self.thing.removesuffix("s") if self.count == 1 else self.thing

    @property
    def extent(self) -> str:
        """How long and how large it is."""
        size = f"{self.num_bytes / 1e6:.1f} MB" if self.num_bytes >= 5e4 else f"{self.num_bytes / 1e3:.0f} kB"
        if math.isnan(self.seconds):
            return size
        minutes, seconds = divmod(round(self.seconds), 60)
        return f"{minutes} min {seconds} s, {size}" if minutes else f"{seconds} s, {size}"


@dataclass(frozen=True)
class Summary:
    """The answers: what was built, from what, a verdict for each stage and topic by name, and what was skipped."""

    made: Sequence[Made]
    sources: Sequence[Credit]
    verdicts: Mapping[str, Verdict]
    skipped: Sequence[str] = ()

    @property
    def built(self) -> str:
        """What was built, in one line."""
        return ", ".join(map(str, self.made)) or "nothing"

    @property
    def origin(self) -> str:
        """What it was built from, in one line."""
        return "; ".join(dict.fromkeys(f"{one.name} ({one.licence})" for one in self.sources)) or "no source"

    @property
    def judgement(self) -> str:
        """How many verdicts there are of each kind, in one line."""
        levels = [verdict.level.value for verdict in self.verdicts.values()]
        return ", ".join(f"{levels.count(level)} {level}" for level in dict.fromkeys(sorted(levels))) or "not judged"

    def lines(self) -> list[str]:
        """All of it, a line for each answer, then one for each verdict and one for what was skipped."""
        verdicts = [f"{name}: {verdict_words(verdict)}" for name, verdict in self.verdicts.items()]
        skipped = [f"skipped: {sentence}" for sentence in self.skipped[:_MAX_SKIPPED]]
        if (rest := len(self.skipped) - _MAX_SKIPPED) > 0:
            skipped.append(f"skipped: {rest} more, all of them in the report and the card")
        answers = [f"built: {self.built}", f"from: {self.origin}", f"is it good: {self.judgement}"]
        return [*answers, *verdicts, *skipped]


def folded(sentences: Iterable[str]) -> list[str]:
    """Merge sentences that are the same after the name of the thing and a colon.

    >>> folded(["waltz: two people.", "hug: two people.", "hug: warm.", "waltz: two people."])
    ['waltz, hug: two people.', 'hug: warm.']
    """
    names: dict[str, list[str]] = {}
    for sentence in dict.fromkeys(sentences):
        name, colon, rest = sentence.partition(": ")
        names.setdefault(colon + rest if colon else sentence, []).append(name if colon else "")
    return [f"{listed(found)}{rest}" for rest, found in names.items()]


def listed(names: Sequence[str]) -> str:
    """Return the first names, and how many more there are."""
    rest = len(names) - _MAX_NAMED
    return ", ".join(names[:_MAX_NAMED]) + (f" and {rest} more" if rest > 0 else "")
