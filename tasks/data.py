"""Takes, variants, draws and contacts of a store as objects for Python and notebooks (`pasdedeux.data`).

Positions are in metres, Y up, as (frame, person, joint, 3); every object says its joints and its rate, gives numpy and
pandas, and shows itself in a notebook with the report's player.  It stands here, as this is the lowest package that may
know both the store and the science.
"""

from __future__ import annotations

import html
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from pasdedeux.augmentation import Source
from pasdedeux.errors import InputError, check_whole
from pasdedeux.evaluation.motion_players import links_of
from pasdedeux.evaluation.pictures import PLAYER, Picture, pack_player, people_panel, shown_frames, times_shown
from pasdedeux.evaluation.report import render
from pasdedeux.interaction.contacts import Contacts
from pasdedeux.people.names import person_names
from pasdedeux.plain_text import counted
from pasdedeux.skeletons import BODY22, PAIR17, Skeleton
from pasdedeux.spread import evenly_spread
from pasdedeux.verdict import Verdict
from storage_schema import ArtifactRef, Manifest, Store, TableData, iter_rows, open_table, parse_reference, resolve
from storage_schema.references import find_rows
from tasks.augmentation import batch_of
from tasks.files.curation import IDENTITY, choices_for, choices_in, content_columns, names_left_out, rows_without
from tasks.rows.contacts import ContactRows, find_contact_rows
from tasks.rows.products import PRODUCT_COLUMNS, product_rows
from tasks.rows.shown_motions import read_shown_motion
from tasks.rows.takes import read_take, read_variants, take_of
from tasks.stage.facts import TakeFacts

if TYPE_CHECKING:
    import pandas as pd

UNIT, UP_AXIS = "m", "Y"
LOOK = "look.html"
"""File of a player beside exported files."""
_MAX_SHOWN = 60
"""Draws that a player shows, evenly spread."""
_DRAWS_PER_S = 5.0
_MAX_PLAYERS = 12
"""Players on a page beside files, at most."""
_OF_PAIRS = ("draws", "seeds", "lifted_pairs", "in_betweens")


def player_page(
    title: str,
    pictures: Sequence[Picture],
    paragraphs: Sequence[str] = (),
    verdicts: Mapping[str, Verdict] | None = None,
) -> str:
    """Return moving people, below the verdicts on them (the worst first) and paragraphs, as one self-contained file."""
    ranked = sorted((verdicts or {}).items(), key=lambda named: -named[1].level.rank)
    return render("players.html", title=title, pictures=pictures, paragraphs=paragraphs, verdicts=ranked)


@dataclass(frozen=True)
class Clip:
    """A take, or a variant of one (then `source` is the take), read from the store when it is first asked for."""

    name: str
    take: Manifest = field(repr=False)
    store: Store = field(repr=False)
    source: Clip | None = None
    part: Manifest | None = field(default=None, repr=False)
    index: int | None = field(default=None, repr=False)
    verdict: str = ""

    unit, up_axis, skeleton = UNIT, UP_AXIS, BODY22

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints."""
        return self.skeleton.joint_names

    @property
    def identity(self) -> str:
        """Its name in files of choices, see `tasks.files.curation`."""
        return self.name.replace(", ", "/")  # names of takes and variants are plain

    @property
    def rate_hz(self) -> float:
        """Frames per second."""
        return TakeFacts.of(self.take).rate_hz

    @cached_property
    def _source(self) -> Source:
        return read_take(self.store, self.take.ref).source

    @cached_property
    def positions_m(self) -> npt.NDArray[np.float64]:
        """Positions (frame, person, joint, 3)."""
        if self.part is None:
            return self._source.positions_m
        return read_variants(self.store, self.part.ref, self.index)[0].astype(np.float64)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> npt.NDArray[Any]:
        return np.array(self.positions_m, dtype=dtype)

    @cached_property
    def _contacts(self) -> Contacts:
        """Contacts that a player marks; for a variant, those of its source."""
        if self.source is not None and self.part is not None:
            return self.source._source.contacts(batch_of(self.part).contacts)
        return self._source.contacts(TakeFacts.of(self.take).contacts)

    @cached_property
    def contacts(self) -> ContactRows:
        """The contacts of this motion, as the table `contacts` has them."""
        ref = self.take.ref if self.part is None else self.part.ref
        return find_contact_rows(self.store, ref, self.positions_m, self.name)

    def pandas(self) -> pd.DataFrame:
        """Return a row for each frame, person and joint: time_s, x_m, y_m, z_m."""
        import pandas as pd

        num_frames, num_people, num_joints = self.positions_m.shape[:3]
        index = pd.MultiIndex.from_product(
            [range(num_frames), person_names(num_people), self.joints], names=["frame", "person", "joint"]
        )
        rows = pd.DataFrame(self.positions_m.reshape(-1, 3), index=index, columns=["x_m", "y_m", "z_m"])
        rows.insert(0, "time_s", np.repeat(np.arange(num_frames) / self.rate_hz, num_people * num_joints))
        return rows

    @property
    def picture(self) -> Picture:
        """The player: the clip with contacts; a variant beside its source."""
        clips = [clip for clip in (self.source, self) if clip is not None]
        frames, rate_hz = shown_frames(min(len(clip.positions_m) for clip in clips), self.rate_hz)
        panels = []
        for clip in clips:
            links = links_of(clip._contacts, clip.positions_m)[frames]
            panels.append(people_panel(clip.name, self.skeleton, clip.positions_m[frames], links))
        where = " (left: its source)" if self.source is not None else ""
        where += "; contacts are green" if self._contacts.weights.size else ""
        times = times_shown(frames, len(self.positions_m), self.rate_hz)
        return Picture(
            f"{self.name}{PLAYER}", f"{self.name}{where}", pack_player(panels, rate_hz=rate_hz, labels=times)
        )

    def _repr_html_(self) -> str:
        return _framed(self.picture)


@dataclass(frozen=True)
class Pairs:
    """Pairs in no order of time, such as draws, (pair, person=2, joint, 3), and which rows of the table they are."""

    name: str
    positions_m: npt.NDArray[np.float64] = field(repr=False)
    rows: npt.NDArray[np.int64] = field(repr=False)

    unit, up_axis, rate_hz = UNIT, UP_AXIS, None
    skeleton: Skeleton = field(default=PAIR17, repr=False)

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints."""
        return self.skeleton.joint_names

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> npt.NDArray[Any]:
        return np.array(self.positions_m, dtype=dtype)

    def __len__(self) -> int:
        return len(self.positions_m)

    def pandas(self) -> pd.DataFrame:
        """Return a row for each pair, person and joint: x_m, y_m, z_m."""
        import pandas as pd

        levels: list[Any] = [self.rows, list("AB"), self.joints]
        index = pd.MultiIndex.from_product(levels, names=["row", "person", "joint"])
        return pd.DataFrame(self.positions_m.reshape(-1, 3), index=index, columns=["x_m", "y_m", "z_m"])

    @property
    def picture(self) -> Picture:
        """The player: some pairs, evenly spread, one after another."""
        at = evenly_spread(len(self), _MAX_SHOWN)
        panel = people_panel(self.name, self.skeleton, self.positions_m[at])
        labels = [f"#{self.rows[index]}" for index in at]
        player = pack_player([panel], rate_hz=_DRAWS_PER_S, labels=labels, has_floor=False)
        return Picture(f"{self.name}{PLAYER}", f"{self.name}: {counted(len(at), 'row')}, one after another", player)

    def _repr_html_(self) -> str:
        return _framed(self.picture)


class Data:
    """The results of studies in a store; `where` is `study`, `study/partition` or `dataset@version`.

    Rejected items are left out, as in exports.

    Args:
        store: Store or its folder.
        curation: File of choices; those of the study or dataset where none is given.

    Raises:
        UnknownReference: The requested table does not exist; the message lists the existing ones.
        InputError: The file of choices is not there, or holds something else.
    """

    def __init__(self, store: Store | str | Path = "store", curation: str | Path | None = None) -> None:
        self.store = store if isinstance(store, Store) else Store(store)
        self.store.refresh()
        self._curation = None if curation is None else Path(curation)
        if self._curation is not None:
            choices_in(self._curation)

    def left_out(self, reference: str) -> Collection[str]:
        """Return the names (`tasks.files.curation`) of the rejected items of a reference."""
        parsed = parse_reference(reference)
        if parsed.table not in IDENTITY:
            return ()
        return names_left_out(self.store, parsed, choices_for(self.store, parsed, self._curation))

    def table(self, reference: str, columns: Sequence[str] | None = None) -> TableData:
        """Return rows as `storage_schema.open_table` does, without those of rejected items."""
        left_out = self.left_out(reference)
        if not left_out:
            return open_table(reference, self.store, columns=columns)
        needed = content_columns(parse_reference(reference).table) or []
        rows = open_table(reference, self.store, columns=None if columns is None else [*{*columns, *needed}])
        kept = rows.rows.take(rows_without(rows, left_out))
        return TableData(rows.table, kept if columns is None else kept.select(columns))

    def takes(self, where: str) -> list[Clip]:
        """Return takes."""
        return list(self._kept(f"poses:{where}", self._takes(f"poses:{where}")))

    def variants(self, where: str) -> list[Clip]:
        """Return the variants of takes, each with its source."""
        return list(self._kept(f"variants:{where}", self.all_variants(f"variants:{where}")))

    def draws(self, where: str) -> Pairs:
        """Return draws."""
        return self.pairs(f"draws:{where}")

    def pairs(self, reference: str, *, count: int | None = None, all_methods: bool = True) -> Pairs:
        """Return the pairs of a table such as `lifted_pairs:study`: all, or a number of them evenly spread.

        For lifted pairs, return those of every method, or of the best one for each annotation (`tasks.rows.products`).

        Raises:
            InputError: The table has no pairs, or the count is no whole number of 1 or more.
        """
        if (table := parse_reference(reference).table) not in _OF_PAIRS:
            raise InputError(f"'{reference}': '{table}' has no pairs; tables that have some: {', '.join(_OF_PAIRS)}")
        if count is not None:
            check_whole(count, "count", minimum=1)
        left_out = self.left_out(reference)
        names = IDENTITY[table] if left_out else ()
        total = sum(rows.stop - rows.start for _, rows in find_rows(parse_reference(reference), self.store))
        wanted = np.arange(total)
        if not all_methods and table in PRODUCT_COLUMNS:
            wanted = product_rows(open_table(reference, self.store, columns=PRODUCT_COLUMNS[table]))
        wanted = wanted if count is None else wanted[evenly_spread(len(wanted), count)]
        pairs_m, kept, first = [np.zeros((0, 2, PAIR17.num_joints, 3))], [wanted[:0]], 0
        for batch in iter_rows(reference, self.store, columns=["pair17_m", *names]):
            in_batch = wanted[(wanted >= first) & (wanted < first + batch.num_rows)] - first
            in_batch = in_batch[np.isin(in_batch, rows_without(batch, left_out))]
            kept.append(first + in_batch)
            pairs_m.append(np.asarray(batch["pair17_m"][in_batch], dtype=np.float64))
            first += batch.num_rows
        return Pairs(reference, np.concatenate(pairs_m), np.concatenate(kept))

    def pictures(self, reference: str) -> list[Picture]:
        """Return the players of a reference, a dozen clips at most; none for tables without people."""
        table = parse_reference(reference).table
        if table in _OF_PAIRS:
            return [self.pairs(reference, count=_MAX_SHOWN, all_methods=False).picture]
        if table == "motions":
            left_out = self.left_out(reference)
            motions = (read_shown_motion(self.store, ref, left_out) for ref in resolve(reference, self.store))
            return [motion.picture for motion in islice(filter(None, motions), _MAX_PLAYERS)]
        of_table = {"poses": self._takes, "variants": self.all_variants}
        clips = of_table[table](reference) if table in of_table else ()
        return [clip.picture for clip in islice(self._kept(reference, clips), _MAX_PLAYERS)]

    def _kept(self, reference: str, clips: Iterable[Clip]) -> Iterator[Clip]:
        left_out = self.left_out(reference)
        return (clip for clip in clips if clip.identity not in left_out)

    def _takes(self, reference: str) -> Iterator[Clip]:
        yield from map(self._take, resolve(reference, self.store))

    def _take(self, ref: ArtifactRef) -> Clip:
        manifest = self.store.manifest(ref)
        return Clip(TakeFacts.of(manifest).take_id, manifest, self.store)

    def all_variants(self, reference: str) -> Iterator[Clip]:
        """Yield the variants of takes, rejected ones, too."""
        takes: dict[ArtifactRef, Clip] = {}
        for ref in resolve(reference, self.store):
            part = self.store.manifest(ref)
            take = take_of(self.store, ref)
            source = takes.setdefault(take, self._take(take))
            quality = self.store.read(ref, "variant_quality", columns=["variant_id", "verdict"])
            for index, (name, verdict) in enumerate(zip(*(quality[column] for column in quality), strict=True)):
                yield Clip(f"{source.name}, {name}", source.take, self.store, source, part, index, str(verdict))


def _framed(picture: Picture) -> str:
    page = html.escape(player_page("", [picture]), quote=True)
    return f'<iframe srcdoc="{page}" style="width:100%;height:27rem;border:0"></iframe>'
