"""Draw the moving picture of the README, an animated WebP of a take and two variants; not a benchmark.

`python -m benchmarks.moving_picture` after `make demo`.
"""

from __future__ import annotations

import argparse
import io
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.bodies import Body, body_of, standing_rest_m
from pasdedeux.bodies.drawing import draw_faces
from pasdedeux.evaluation.motion_players import links_of
from pasdedeux.evaluation.pictures import LINK_COLOUR, person_rgb, rgb, shown_frames
from pasdedeux.plausibility.capsules import capsule_model
from pasdedeux.skeletons import BODY22
from tasks.data import Clip, Data

_PITCH_RAD = 0.18
_FINER = 2
"""Drawn so many times larger, so that edges are smooth."""
_TITLE_PX, _BOTTOM_PX, _GAP_M = 34, 12, 0.35
_PAPER, _FLOOR, _INK = (252, 252, 251), (195, 202, 211), (28, 36, 48)
_QUALITY = 40
_MAX_FRAMES = 45
"""Frames of the picture, at most: more of them than a page should load first."""


def clips_picture(clips: dict[str, Clip]) -> bytes:
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
    arguments = parser.parse_args()
    there = {variant.name.rpartition(", ")[2]: variant for variant in Data(arguments.store).variants(arguments.take)}
    chosen = {name: there[name] for name in arguments.variants}
    (source,) = {clip.source.name: clip.source for clip in chosen.values() if clip.source is not None}.values()
    arguments.out.write_bytes(
        clips_picture({"source": source, **{_title(name): clip for name, clip in chosen.items()}})
    )


def _title(variant_id: str) -> str:
    """Say what a variant is: `person A at 0.75`."""
    who, _, scale = variant_id.split("-")
    return f"person {who} at {scale} of the size"


@dataclass(frozen=True)
class MovingPeople:
    """People (frame, person, 22, 3), metres, Y up, their title, and points of contacts (frame, n, 2, 3), NaN: none."""

    title: str
    people_m: Array
    links_m: Array


def moving_picture(groups: Sequence[MovingPeople], *, rate_hz: float, width: int = 720) -> bytes:
    """Return groups side by side on one floor, at one scale, as an animated WebP that repeats for ever.

    Each group stands about the middle of its own path.  The same groups always give the same bytes on one platform.
    """
    import cv2
    from PIL import Image, ImageDraw, ImageFont

    middles = [group.people_m.reshape(-1, 3).mean(axis=0) * (1.0, 0.0, 1.0) for group in groups]
    reach = (
        max(float(np.abs(group.people_m - at)[..., 0].max()) for group, at in zip(groups, middles, strict=True))
        + _GAP_M
    )
    scale = _FINER * width / (2.0 * reach * len(groups))
    top_m = max(float(group.people_m[..., 1].max()) for group in groups) + 0.1
    deep_m = (
        max(float(np.abs(group.people_m - at)[..., 2].max()) for group, at in zip(groups, middles, strict=True)) + 0.2
    )
    cos, sin = np.cos(_PITCH_RAD), np.sin(_PITCH_RAD)
    floor_px = _FINER * _TITLE_PX + scale * (cos * top_m + sin * deep_m)
    to_view = np.array([[1.0, 0.0, 0.0], [0.0, cos, sin], [0.0, -sin, cos]])
    size = (_FINER * width, int(floor_px + scale * sin * deep_m) + _FINER * _BOTTOM_PX)

    def project(points: Array, number: int) -> Array:
        """Return pixels right and down (*batch, 2)."""
        return on_canvas((points - middles[number]) @ to_view, number)

    def on_canvas(seen: Array, number: int) -> Array:
        """Return pixels of points in axes of the view (*batch, 3): right, up, towards the viewer."""
        return np.stack([scale * (seen[..., 0] + reach * (2 * number + 1)), floor_px - scale * seen[..., 1]], axis=-1)

    def line(canvas: np.ndarray, ends: Array, colour: tuple[int, ...], thick: float) -> None:
        start, stop = (tuple(int(value) for value in end[:2]) for end in ends)
        cv2.line(canvas, start, stop, colour, max(1, round(thick)), cv2.LINE_AA)

    bodies = [_bodies(group.people_m) for group in groups]
    font = ImageFont.truetype(_font_path(), 14)
    frames = []
    for frame in range(len(groups[0].people_m)):
        canvas = np.full((size[1], size[0], 3), _PAPER, dtype=np.uint8)
        for z in np.linspace(-deep_m, deep_m, 5):
            ends = [project(middles[at] + [side * reach, 0.0, z], at) for at, side in ((0, -1), (len(groups) - 1, 1))]
            line(canvas, np.stack(ends), _FLOOR, _FINER)
        for number, group in enumerate(groups):
            corners, colours = [], []
            for person, body in enumerate(bodies[number]):
                joints = group.people_m[frame, person]
                posed = body.posed(body.turns(BODY22, joints), joints) - middles[number]
                corners.append((posed @ to_view)[body.faces])
                colours += [person_rgb(person)] * len(body.faces)
            draw_faces(canvas, np.concatenate(corners), np.array(colours), partial(on_canvas, number=number))
            for ends in project(group.links_m[frame], number):
                if np.isfinite(ends).all():
                    line(canvas, ends, rgb(LINK_COLOUR), 2 * _FINER)
                    for end in ends:
                        line(canvas, np.stack([end, end]), (255, 255, 255), 8 * _FINER)
                        line(canvas, np.stack([end, end]), rgb(LINK_COLOUR), 6 * _FINER)
        image = Image.fromarray(cv2.resize(canvas, (width, size[1] // _FINER), interpolation=cv2.INTER_AREA))
        pen = ImageDraw.Draw(image)
        for number, group in enumerate(groups):
            pen.text((width * (number + 0.5) / len(groups), 8), group.title, fill=_INK, font=font, anchor="ma")
        frames.append(image)
    buffer = io.BytesIO()
    more = {"duration": round(1000 / rate_hz), "loop": 0, "quality": _QUALITY, "method": 4}
    frames[0].save(buffer, format="WEBP", save_all=True, append_images=frames[1:], **more)
    return buffer.getvalue()


def _bodies(people_m: Array) -> list[Body]:
    """Return everybody's body, by positions (frame, person, 22, 3), metres."""
    radii = capsule_model(BODY22).radii_of(people_m)
    rests = (standing_rest_m(BODY22, positions_m) for positions_m in np.moveaxis(people_m, 1, 0))
    return [body_of(BODY22, rest, radius) for rest, radius in zip(rests, radii, strict=True)]


def _font_path() -> str:
    from matplotlib import font_manager

    return font_manager.findfont("DejaVu Sans")


if __name__ == "__main__":
    main()
