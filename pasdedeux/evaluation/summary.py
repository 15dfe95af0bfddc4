"""Summary of a run: products, sources and verdicts, for the report, the dataset card and the console."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from pasdedeux.evaluation.names import in_words
from pasdedeux.evaluation.verdicts import verdict_words
from pasdedeux.plain_text import counted, together
from pasdedeux.verdict import Level, Verdict

_MAX_SKIPPED = 8
"""Most sentences on skipped data among the last lines of the console; the report and the card have all."""
_MAX_NAMED = 6
"""Most names in a sentence that several things share."""
_USABLE = {Level.PASS: "usable", Level.WARN: "usable, some with warnings", Level.FAIL: "not all usable"}
_COMPARED = {Level.PASS: "better than {}", Level.WARN: "no better than {}", Level.FAIL: "worse than {}"}
_PRODUCTS: Mapping[str, Mapping[str, Mapping[Level, str]]] = {
    "takes": {"ingest": _USABLE},
    "variants": {
        "augmentation": _USABLE,
        "evaluation: augmentation": {
            **{level: f"contacts kept {words}" for level, words in _COMPARED.items()},
            Level.NOT_JUDGED: "contacts not compared",
        },
    },
    "draws": {
        "chains": {Level.PASS: "independent", Level.WARN: "not independent", Level.FAIL: "not independent"},
        "evaluation: coverage": {level: f"cover real pairs {words}" for level, words in _COMPARED.items()},
        "evaluation: leave one out": {level: f"match left-out images {words}" for level, words in _COMPARED.items()},
    },
    "lifted pairs": {"evaluation: lifting": _COMPARED},
    "completed joints": {"evaluation: lifting completed joints": _COMPARED},
    "frames between": {
        f"evaluation: lifting frames between{ends}": {level: f"{where}{words}" for level, words in _COMPARED.items()}
        for ends, where in {"": "", " lifted pairs": "between lifted pairs "}.items()
    },
    "reconstruction": {"evaluation: reconstruction": _COMPARED},
    "models": {"evaluation: models": _COMPARED},
    "generated motion": {"evaluation: generation": _COMPARED},
}
"""Products of a run: the verdicts on each, or on its parts, and their meaning in a few words."""
_ADVICE = {
    Level.PASS: "use {}",
    Level.NOT_JUDGED: "look at {} yourself, which could not be judged",
    Level.WARN: "read the warnings on {}",
    Level.FAIL: "do not use {}",
}
_IN_PART = "leave out {} that fail"
"""Advice on a product of which only some results fail by themselves, such as takes."""
_JUDGES = tuple(start for judges in _PRODUCTS.values() for start in judges)


@dataclass(frozen=True)
class Credit:
    """A source that the data was made from."""

    name: str
    licence: str
    credit: str


@dataclass(frozen=True)
class Made:
    """Amount of one product: its name in the plural, number, seconds of motion (NaN if none), bytes.

    `independent` is the number of independent items and their name, if not all are independent.
    """

    thing: str
    count: int
    seconds: float
    num_bytes: int
    independent: tuple[int, str] | None = None

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
class Product:
    """A product of a run: its name and the verdicts on it, the worst first."""

    name: str
    verdicts: Mapping[str, Verdict]

    @property
    def level(self) -> Level:
        """The worst level."""
        return max((verdict.level for verdict in self.verdicts.values()), key=lambda level: level.rank)

    @property
    def advice(self) -> str:
        """Advice on its use, with a placeholder for its name; empty if nothing is judged."""
        failed = {name: verdict for name, verdict in self.verdicts.items() if verdict.level is Level.FAIL}
        by_result = all(_PRODUCTS[self.name][str(_judge_of(name))] is _USABLE for name in failed)
        is_whole = any(all(row[0] is Level.FAIL for row in verdict.tally) for verdict in failed.values())
        if failed and by_result and not is_whole:
            return _IN_PART
        return _ADVICE.get(self.level, "")

    @property
    def words(self) -> str:
        """The verdicts in words: `usable; contacts kept better than plain forward kinematics`."""
        said = []
        for name, verdict in self.verdicts.items():
            words = _PRODUCTS[self.name][str(_judge_of(name))]
            said.append(words.get(verdict.level, "not judged").format(in_words(verdict.baseline_name) or "allowed"))
        return "; ".join(dict.fromkeys(said))


@dataclass(frozen=True)
class Summary:
    """The products, their sources, a verdict for each stage and topic by name, and all skipped work."""

    made: Sequence[Made]
    sources: Sequence[Credit]
    verdicts: Mapping[str, Verdict]
    skipped: Sequence[str] = ()

    @property
    def built(self) -> str:
        """The products, in one line."""
        return ", ".join(map(str, self.made)) or "nothing"

    @property
    def origin(self) -> str:
        """The sources, in one line."""
        return (
            "; ".join(dict.fromkeys(f"{source.name} (licence: {source.licence})" for source in self.sources))
            or "no source"
        )

    @property
    def judgement(self) -> str:
        """How many verdicts there are of each kind, in one line."""
        levels = [verdict.level.value for verdict in self.verdicts.values()]
        return ", ".join(f"{levels.count(level)} {level}" for level in dict.fromkeys(sorted(levels))) or "not judged"

    @property
    def products(self) -> list[Product]:
        """The products, the worst first, with their verdicts: those on parts if the whole topic has none."""
        counted = [name for name in self.verdicts if _judge_of(name) == name or _judge_of(name) not in self.verdicts]
        judged = {
            product: _worst_first({name: self.verdicts[name] for name in counted if _judge_of(name) in judges})
            for product, judges in _PRODUCTS.items()
        }
        products = [Product(product, verdicts) for product, verdicts in judged.items() if verdicts]
        return sorted(products, key=lambda product: -product.level.rank)

    @property
    def advice(self) -> str:
        """Advice on all products in one sentence; empty without a product.

        >>> verdicts = {"augmentation": Verdict(Level.PASS), "evaluation: coverage": Verdict(Level.FAIL, "far")}
        >>> Summary([], [], verdicts).advice
        'Use the variants; do not use the draws.'
        >>> Summary([], [], {"evaluation: models": Verdict(Level.NOT_JUDGED, "too little")}).advice
        'Look at the models yourself, which could not be judged.'
        """
        named: dict[str, list[str]] = {}
        for product in self.products:
            named.setdefault(product.advice, []).append(f"the {product.name}")
        order = [words for words in (*_ADVICE.values(), _IN_PART) if words in named]
        sentence = "; ".join(words.format(together(named[words])) for words in order)
        return f"{sentence[0].upper()}{sentence[1:]}." if sentence else ""

    @property
    def is_compared(self) -> bool:
        """Whether there are verdicts of the evaluation beside those of stages."""
        return len({name.startswith("evaluation: ") for name in self.verdicts}) == 2

    @property
    def ranked(self) -> tuple[dict[str, Verdict], dict[str, Verdict]]:
        """The verdicts on products and those that fail, and the others; of both the worst first."""
        first = {name: verdict for product in self.products for name, verdict in product.verdicts.items()}
        first |= {name: verdict for name, verdict in self.verdicts.items() if verdict.level is Level.FAIL}
        others = {name: verdict for name, verdict in self.verdicts.items() if name not in first}
        return _worst_first(first), _worst_first(others)

    def headlines(self) -> list[str]:
        """Return the last lines of a run: the three answers, advice, each product, and each failed verdict."""
        failed = {
            name: verdict for name, verdict in self.verdicts.items() if verdict.level is Level.FAIL or not self.products
        }
        lines = [*self._answers, *filter(None, [self.advice]), *self._product_lines()]
        lines += [f"{name}: {verdict_words(verdict)}" for name, verdict in failed.items()]
        if rest := len(self.verdicts) - len(failed):
            lines.append(
                f"{counted(rest, 'more verdict')}, and what was skipped: see the report, or `pasdedeux status`"
            )
        return lines

    def _product_lines(self) -> list[str]:
        return [f"{product.name}: {product.level.value}: {product.words}" for product in self.products]

    @property
    def good(self) -> list[str]:
        """Answer of the page to whether it is good: a line for each product, then for each verdict."""
        return self._product_lines() + [
            f"{name}: {verdict_words(verdict)}" for part in self.ranked for name, verdict in part.items()
        ]

    def lines(self) -> list[str]:
        """Return all lines: for each answer, each product, each verdict, and for skipped data."""
        skipped = [f"skipped: {sentence}" for sentence in self.skipped[:_MAX_SKIPPED]]
        if (rest := len(self.skipped) - _MAX_SKIPPED) > 0:
            skipped.append(f"skipped: {rest} more, all of them in the report and the card")
        return [*self._answers, *self.good, *skipped]

    @property
    def _answers(self) -> list[str]:
        return [f"built: {self.built}", f"from: {self.origin}", f"is it good: {self.judgement}"]


def _judge_of(name: str) -> str | None:
    """Return the judging verdict that a name is, or is a part of: the longest match."""
    return max((start for start in _JUDGES if f"{name} ".startswith(f"{start} ")), key=len, default=None)


def _worst_first(verdicts: Mapping[str, Verdict]) -> dict[str, Verdict]:
    return dict(sorted(verdicts.items(), key=lambda named: -named[1].level.rank))


def folded(sentences: Iterable[str]) -> list[str]:
    """Merge sentences that are the same after the name of the thing and a colon.

    >>> folded(["waltz: two people.", "hug: two people.", "hug: warm.", "waltz: two people."])
    ['waltz, hug: two people.', 'hug: warm.']
    """
    names: dict[str, list[str]] = {}
    for sentence in dict.fromkeys(sentences):
        name, colon, rest = sentence.partition(": ")
        names.setdefault(colon + rest if colon else sentence, []).append(name if colon else "")
    return [f"{listed(who)}{rest}" for rest, who in names.items()]


def listed(names: Sequence[str]) -> str:
    """Return the first names, and how many more there are."""
    rest = len(names) - _MAX_NAMED
    return ", ".join(names[:_MAX_NAMED]) + (f" and {rest} more" if rest > 0 else "")
