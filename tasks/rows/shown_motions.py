"""Reconstructed motions of a sequence as the page's player shows them."""

from __future__ import annotations

from collections.abc import Collection
from typing import NamedTuple

from pasdedeux.arrays import Array
from pasdedeux.evaluation.motion_players import reconstruction_player
from pasdedeux.evaluation.names import in_words
from pasdedeux.evaluation.pictures import PLAYER, Picture
from storage_schema import ArtifactRef, Store, TableData
from tasks.files.curation import without
from tasks.rows.products import product_rows
from tasks.rows.takes import by_frame_and_person, rate_of


class ShownMotion(NamedTuple):
    """Result of the best method for a sequence; arguments of `reconstruction_player`."""

    sequence_id: str
    caption: str
    found_m: Array
    rate_hz: float
    keypoints_px: Array | None = None
    truth_m: Array | None = None

    @property
    def picture(self) -> Picture:
        """The player."""
        content = reconstruction_player(
            self.found_m, rate_hz=self.rate_hz, keypoints_px=self.keypoints_px, truth_m=self.truth_m
        )
        return Picture(f"reconstruction-{self.sequence_id.replace('/', '-')}{PLAYER}", self.caption, content)


def read_motion_rows(store: Store, motions: ArtifactRef) -> TableData:
    """Return the positions of everybody by every method."""
    return store.read(motions, "motions", columns=["sequence_id", "person_id", "frame", "time_s", "method", "op14_m"])


def read_shown_motion(store: Store, motions: ArtifactRef, left_out: Collection[str] = ()) -> ShownMotion | None:
    """Return the product of a sequence without rejected parts (`tasks.files.curation`); None if nothing remains."""
    table = without(read_motion_rows(store, motions), left_out)
    table = TableData(table.table, table.rows.take(product_rows(table)))
    if not table.num_rows:
        return None
    method, sequence_id = str(table["method"][-1]), str(table["sequence_id"][0])
    positions_m, _, _ = by_frame_and_person(table["frame"], table["person_id"], table["op14_m"])
    caption = (
        f"{sequence_id}: reconstructed ({in_words(method)}; Yiannakides et al. 2019, fig. 6), "
        "a colour for each person. Turn it: limbs that are too "
        "short or bent wrongly show from the side."
    )
    return ShownMotion(sequence_id, caption, positions_m, rate_of(table["time_s"]))
