"""The moving picture of the README: a take and two of its variants, `python -m tasks.moving_picture`."""

from __future__ import annotations

import argparse
from pathlib import Path

from pasdedeux.evaluation.motion_players import links_of
from pasdedeux.evaluation.moving import MovingPeople, moving_picture
from pasdedeux.evaluation.pictures import shown_frames
from tasks.data import Clip, Data

_MAX_FRAMES = 45
"""Frames of the picture, at most: more of them than a page should load first."""


def picture_of(clips: dict[str, Clip]) -> bytes:
    """Return clips by title, side by side on one floor, contacts marked, some seconds from the middle."""
    first = next(iter(clips.values()))
    frames, rate_hz = shown_frames(len(first.positions_m), first.rate_hz)
    frames = frames[:_MAX_FRAMES]
    groups = [
        MovingPeople(title, clip.positions_m[frames], links_of(clip._contacts, clip.positions_m)[frames])
        for title, clip in clips.items()
    ]
    return moving_picture(groups, rate_hz=rate_hz)


def main() -> None:
    """Draw the picture from what `make demo` builds, or from another study, partition and variants."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--store", default="store")
    parser.add_argument("--take", default="duets/waltz", help="study/partition of the variants")
    parser.add_argument("--variants", nargs="+", default=["A-uniform-0.75", "A-uniform-1.25"])
    parser.add_argument("--out", type=Path, default=Path("docs/variants.webp"))
    told = parser.parse_args()
    there = {variant.name.rpartition(", ")[2]: variant for variant in Data(told.store).variants(told.take)}
    chosen = {name: there[name] for name in told.variants}
    (source,) = {clip.source.name: clip.source for clip in chosen.values() if clip.source is not None}.values()
    told.out.write_bytes(picture_of({"source": source, **{_title(name): clip for name, clip in chosen.items()}}))


def _title(variant_id: str) -> str:
    """Say what a variant is: `person A at 0.75`."""
    who, _, scale = variant_id.split("-")
    return f"person {who} at {scale} of the size"


if __name__ == "__main__":
    main()
