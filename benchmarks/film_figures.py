"""Measure the figures of film: tracking against interpolation, speed, crossing people, lifted pairs; not a test.

`python -m benchmarks.film_figures DATA` with the folder of real motion data; a quarter of an hour on one core.
"""

from __future__ import annotations

import argparse
import resource
import sys
import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
from scipy.interpolate import CubicSpline, PchipInterpolator

from flows.console.app import run_command_line
from pasdedeux.film.annotating import annotate_shot
from pasdedeux.formats.poses2d.annotation_csv import write_annotation_csv
from pasdedeux.kinematics.alignment import align_rigid
from pasdedeux.people.resolution import SequenceRows, resolve_sequence
from pasdedeux.skeletons.layouts import KEYPOINT_LAYOUTS
from storage_schema import open_table
from tests.builders.crowds import SALSA_TAKES, salsa_couple
from tests.builders.filmed_people import film as seen_by_detector
from tests.builders.rendered_film import Film, render, rows_of, salsa_bodies, write_film

EVERY = 15
_PARTS = ("tracking", "large", "crossings", "whole")
_LIFTED = ("sequence_id", "frame", "method", "pair17_m")


def tracked(film: Film, hidden: float) -> dict[str, float]:
    """Return mean errors over visible joints between key frames, % of body height, and the share of filled ones."""
    given = rows_of(film, sorted({*range(0, len(film.px), EVERY), len(film.px) - 1}), hidden=hidden)
    start = time.process_time()
    frames = annotate_shot(given, iter(film.images), 0, len(film.images), is_key=True).frames
    seconds = time.process_time() - start
    px = np.full(film.px.shape, np.nan)
    px[frames.frame, frames.person_id] = frames.keypoints_px
    keys, count = np.unique(given.frame), len(film.px)
    is_between = film.is_visible & ~np.isin(np.arange(count), keys)[:, None, None]
    is_filled = is_between & np.isfinite(px[..., 0])
    flat = film.px.reshape(count, -1)
    others = {
        "linear": np.stack([np.interp(np.arange(count), keys, column) for column in flat[keys].T], axis=-1),
        "pchip": PchipInterpolator(keys, flat[keys])(np.arange(count)),
        "spline": CubicSpline(keys, flat[keys])(np.arange(count)),
    }

    def error(places: np.ndarray) -> float:
        away = np.linalg.norm(places.reshape(film.px.shape) - film.px, axis=-1)
        return 100.0 * float(away[is_filled].mean()) / film.height_px

    errors = {"tracked": error(px), **{name: error(track) for name, track in others.items()}}
    return errors | {"filled": is_filled.sum() / is_between.sum(), "frames_per_s": count / seconds}


def crossings(data: Path, take: str, seed: int) -> tuple[int, int, int]:
    """Return the numbers of crossings of two people, of those with correct identities afterwards, and of frames."""
    rng = np.random.default_rng(seed)
    seen = seen_by_detector(rng, salsa_couple(data, take), noise_px=6.0)
    is_missed = rng.random(seen.confidence.shape) < 0.1
    confidence = np.where(is_missed, 0.0, seen.confidence)
    order = np.arange(len(seen.frame))
    place = order % 2
    rows = SequenceRows(seen.frame, place, seen.keypoints_px, confidence, order)
    resolved = resolve_sequence(take, rows, KEYPOINT_LAYOUTS["op14"], rate_hz=seen.rate_hz, has_identities=False).rows
    true = seen.true_id[resolved.source_row]
    offset = np.full(int(seen.frame.max()) + 1, np.nan)
    middle = np.nanmean(np.where(confidence[..., None] > 0, seen.keypoints_px, np.nan)[:, 2:12, 0], axis=1)
    for frame in range(len(offset)):
        both = {int(seen.true_id[row]): middle[row] for row in np.flatnonzero(seen.frame == frame)}
        offset[frame] = both[1] - both[0]
    clear = np.flatnonzero(np.abs(offset) > 0.1 * np.nanmax(np.abs(offset)))
    changes = [(a, b) for a, b in pairwise(clear) if offset[a] * offset[b] < 0]
    take_id = {
        (int(frame), int(who)): int(name)
        for frame, who, name in zip(resolved.frame, true, resolved.person_id, strict=True)
    }
    kept = sum(
        take_id.get((a, 0)) == take_id.get((b, 0)) and take_id.get((a, 1)) == take_id.get((b, 1)) for a, b in changes
    )
    return len(changes), kept, len(offset)


_WHOLE = """
[study]
name = "{name}"
title = "Rendered salsa"
stages = ["ingest", "priors", "views", "seeds", "chains", "lifting"]
[ingest]
{sources}
[seeds]
num_lifted = 20
num_grown = 1000
[chains]
densities = ["ic"]
num_chains = 1
num_draws = 250
[lifting]
max_frames = 40
"""


def whole(data: Path, folder: Path) -> dict[str, dict[str, float]]:
    """Return errors of pairs, metres, by take and method: lifted from film with key frames, and from perfect 2D."""
    truth, errors, sources = {}, {}, {"film": "", "perfect": ""}
    for take, start, yaw_rad in (("03", 200, 0.5), ("07", 300, 2.0), ("12", 100, -1.0)):
        bodies = salsa_bodies(data, take, slice(start, start + 91))
        film = render(bodies, yaw_rad=yaw_rad, turn_rad=0.0, seed=5)
        truth[f"s{take}"] = bodies.pair17_m
        write_film(folder / f"{take}.mp4", film.images)
        for name, frames in (("film", {*range(0, 91, EVERY)}), ("perfect", set(range(91)))):
            keys = folder / f"{name}{take}.csv"
            given = replace(rows_of(film, sorted(frames)), image_size_px={"film": (640, 480)})
            keys.write_text(write_annotation_csv(given))
            files = f'path = "{folder / take}.mp4"\nkeys = "{keys}"' if name == "film" else f'path = "{keys}"'
            table = "videos" if name == "film" else "annotations"
            sources[name] += f'[[ingest.{table}]]\nid = "s{take}"\n{files}\n'
    for name, tables in sources.items():
        study = folder / f"{name}.toml"
        study.write_text(_WHOLE.format(name=name, sources=tables))
        assert run_command_line(["run", str(study), "--store", str(folder / "store"), "--workers", "0"]) == 0
        rows = open_table(f"lifted_pairs:{name}", folder / "store")
        distances: dict[str, list[float]] = {}
        for sequence, frame, method, pair in zip(*(rows[column] for column in _LIFTED), strict=True):
            take_id = str(sequence).partition(".")[0]
            points, true = pair.reshape(-1, 3).astype(np.float64), truth[take_id][frame].reshape(-1, 3)
            error = float(np.linalg.norm(align_rigid(points, true).apply(points) - true, axis=-1).mean())
            for key in (f"{take_id} {method}", f"all {method}"):
                distances.setdefault(key, []).append(error)
        errors[name] = {key: float(np.mean(values)) for key, values in distances.items()}
    return errors


def print_now(line: str) -> None:
    """Print a line at once."""
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("--part", choices=_PARTS, action="append")
    options = parser.parse_args()
    parts = options.part or _PARTS
    cv2.setNumThreads(1)
    for part, size, takes in (("tracking", (640, 480), SALSA_TAKES), ("large", (1920, 1080), ("03", "12"))):
        results = []
        for index, take in enumerate(takes if part in parts else ()):
            bodies = salsa_bodies(options.data, take, slice(150, 226 if part == "tracking" else 196))
            film = render(bodies, size=size, yaw_rad=2.4 * index, seed=index)
            for hidden in (0.5, 0.0):
                results.append((hidden, tracked(film, hidden)))
                words = ", ".join(f"{name} {value:.3g}" for name, value in results[-1][1].items())
                print_now(
                    f"{size[0]} x {size[1]}, salsa {take}, hidden {'labelled' if hidden else 'left out'}: {words}"
                )
        for hidden in sorted({kind for kind, _ in results}):
            mean = {
                name: np.mean([figures[name] for kind, figures in results if kind == hidden]) for name in results[0][1]
            }
            print_now(f"mean, {hidden}: " + ", ".join(f"{name} {value:.3g}" for name, value in mean.items()))
    if "whole" in parts:
        with TemporaryDirectory() as folder:
            errors = whole(options.data, Path(folder))
        for key, perfect in sorted(errors["perfect"].items()):
            ours = errors["film"][key]
            print_now(f"{key}: film {100 * ours:.1f} cm, perfect 2D {100 * perfect:.1f} cm, ratio {ours / perfect:.2f}")
    if "crossings" in parts:
        counts = [
            crossings(options.data, take, 10 * index + view)
            for index, take in enumerate(SALSA_TAKES)
            for view in range(2)
        ]
        total, kept, frames = (sum(count[at] for count in counts) for at in range(3))
        print_now(f"crossings: {kept} of {total} kept ({kept / max(total, 1):.2%}), {frames} frames")
    print_now(f"memory: {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB with the rendered film")


if __name__ == "__main__":
    main()
