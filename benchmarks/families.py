"""Errors on unseen motion: clips of nine families, each reconstructed from the takes of the others.

    python -m benchmarks.families DATA                      reconstruction-by-family.md: seven clips of each family
    python -m benchmarks.families DATA --families hug,judo --clips 3
    python -m benchmarks.families DATA --lens --stature     with stated focal length and statures
    python -m benchmarks.families DATA --no-level           without the level camera, for half the time
    python -m benchmarks.families DATA --clips 4 --seed 2 --pitches=-18,-24,-30,-36  other clips, cameras that look up

DATA is a folder of motion capture with `cmu_salsa_bvh`, `cmu_asfamc` (both from CMU) and `contact_pairs`, the folder of
PASDEDEUX_DATA.  The database is built once, in --store.  Clips last 4 s at 30 Hz: people of 1.5 to 2.0 m, pitches of -6
to 42 degrees, unknown lenses of 0.72 and 1.15 of the image's width, 3 px of correlated noise, 5 % of the joints
missing.  The output has the errors and their baselines, the coverage of expected errors, and the constants of
`reconstruction.reliability`, fitted on all families and cross-validated over families and over halves of them.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import stats
from threadpoolctl import threadpool_limits

from flows.console.app import run_command_line
from pasdedeux.cameras.virtual_video import look_at_camera
from pasdedeux.kinematics.forward import bone_lengths
from pasdedeux.plausibility.capsules import body_height_m
from pasdedeux.projections.retarget import mid_hip
from pasdedeux.reconstruction.errors import root_centred_error_m
from pasdedeux.reconstruction.matching import Method
from pasdedeux.reconstruction.people import SequenceOptions
from pasdedeux.reconstruction.sequence import Reconstruction, SearchedDatabase, StatedCamera, reconstruct_sequence
from pasdedeux.reconstruction.tracks import Lens, Track
from pasdedeux.skeletons import OP14
from storage_schema import Store, read_latest
from tasks.projections import read_pairs, read_searched
from tasks.rows.takes import read_motion
from tasks.stage.facts import ProjectionFacts, TakeFacts

Array = npt.NDArray[np.float64]

FAMILIES = {
    "salsa": ("salsa_01", "salsa_03", "salsa_06", "salsa_10", "salsa_12"),
    "waltz": ("waltz", "waltz-001"),
    "hug": ("hug", "hug-001"),
    "judo": ("judo", "judo-001", "push_hands"),
    "lift": ("lift", "lift-001"),
    "lying": ("push_up001", "stack_push_up001"),
    "greeting": ("High_five", "box_throw"),
    "everyday": ("02_01", "02_02", "02_03", "02_05", "02_10", "03_01", "20_11"),
    "climbing": ("01_01", "01_13"),
}
RATE_HZ, SECONDS, WIDTH, HEIGHT = 30.0, 4.0, 1920, 1080
PITCHES_DEG = (-5, 0, 5, 8, 12, 20, 30, 40)
LARGE_M = 0.12
"""Limit of large errors, which are to be recognised."""


@dataclass(frozen=True)
class ClipSettings:
    """Part of a take, statures of its people, and camera of a clip."""

    family: str
    take: str
    first_frame: int
    pitch_deg: float
    focal_px: float
    stature_m: float
    seed: int
    yaw_rad: float


@dataclass(frozen=True)
class FilmedClip:
    """A filmed clip: tracks, true positions (frame, person, 14, 3) in camera axes, and the height of the camera."""

    clip: ClipSettings
    tracks: list[Track]
    truth_m: Array
    height_m: float


def study_of(data: Path) -> str:
    """Return the study that reads all takes and projects their poses."""
    salsa = [name.removeprefix("salsa_") for name in FAMILIES["salsa"]]
    duets = [{"name": name} for name in ("waltz", "hug", "judo", "push_hands", "lift")]
    duets += [{"name": name, "count": 1, "duration_s": 6} for name in ("waltz", "hug", "judo")]
    duets += [{"name": "lift", "count": 1, "duration_s": 8}]
    takes: list[dict[str, Any]] = []
    for name in (*FAMILIES["lying"], *FAMILIES["greeting"]):
        files = [str(data / "contact_pairs" / f"{name}_S{person}.bvh") for person in (1, 2)]
        takes.append({"id": name, "files": files, "metres_per_unit": 0.0254})
    for name in (*FAMILIES["everyday"], *FAMILIES["climbing"]):
        bones = str(data / "cmu_asfamc" / f"{name[:2]}.asf")
        files = [str(data / "cmu_asfamc" / f"{name}.amc")]
        takes.append({"id": name, "files": files, "rate_hz": 120, "persons": [{"skeleton": bones}]})
    lines = [
        '[study]\nname = "families"\nseed = 1\nstages = ["ingest", "projections"]',
        f"[ingest]\nrate_hz = {RATE_HZ:g}\ntake_seconds = 15",
        f"duets = [{', '.join(_inline(duet) for duet in duets)}]",
        f'[ingest.pairs.salsa]\nfolder = {json.dumps(str(data / "cmu_salsa_bvh"))}\nsubjects = ["60", "61"]',
        f'takes = {json.dumps(salsa)}\nid = "salsa_{{take}}"\nrate_hz = 60',
        *(
            "[[ingest.takes]]\n" + "\n".join(f"{key} = {_inline(value)}" for key, value in take.items())
            for take in takes
        ),
        "[ingest.virtual_video]\nnum_videos = 0\nnum_random_views = 0\n",
    ]
    return "\n".join(lines)


def _inline(value: Any) -> str:
    """Return a value as TOML."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {_inline(item)}" for key, item in value.items()) + " }"
    return f"[{', '.join(map(_inline, value))}]" if isinstance(value, list) else json.dumps(value)


class Takes:
    """The takes of all families, and for each family a database without it."""

    def __init__(self, data: Path, store: Path) -> None:
        store.mkdir(parents=True, exist_ok=True)
        study = store / "families.toml"
        study.write_text(study_of(data.resolve()))
        if run_command_line(["run", str(study), "--store", str(store), "--workers", "0"]) != 0:
            raise SystemExit("the database could not be built")
        self._store = Store(store)
        last = read_latest(self._store, "families")
        assert last is not None
        self._parts = last.refs("projections")
        self.poses_m: dict[str, Array] = {}
        for ref in last.refs("ingest"):
            manifest = self._store.manifest(ref)
            if "poses" in manifest.tables:
                poses = read_motion(self._store, ref, "op14_m")["op14_m"]
                self.poses_m[TakeFacts.of(manifest).take_id] = poses.astype(np.float64)

    def without(self, family: str) -> SearchedDatabase:
        """Return the database of the takes of all other families."""
        takes_of_family = set(FAMILIES[family])
        refs = [
            ref for ref in self._parts if not takes_of_family & set(ProjectionFacts.of(self._store.manifest(ref)).takes)
        ]
        database = replace(read_searched(self._store, refs), pairs_m=read_pairs(self._store, refs))
        return replace(database, ready=tuple(database.searcher(pitch) for pitch in database.pitches_rad))

    def clips(self, num_clips: int, *, seed: int = 0, pitches_deg: Sequence[float] = PITCHES_DEG) -> list[ClipSettings]:
        """Return so many clips of each family; clips of different seeds are independent."""
        rng, clips = np.random.default_rng(seed), list[ClipSettings]()
        for family, takes in FAMILIES.items():
            for number in range(num_clips):
                take = takes[number % len(takes)]
                start = int(rng.integers(0, max(len(self.poses_m[take]) - int(SECONDS * RATE_HZ), 0) + 1))
                pitch = pitches_deg[(number * 3 + len(clips) // num_clips) % len(pitches_deg)] + rng.uniform(-2, 2)
                stature, seed = float(rng.uniform(1.5, 2.0)), int(rng.integers(1e9))
                yaw = float(rng.uniform(-np.pi, np.pi))
                focal = (0.72, 1.15)[number % 2] * WIDTH
                clips.append(ClipSettings(family, take, start, float(pitch), focal, stature, seed, yaw))
        return clips

    def seen(self, clip: ClipSettings, *, has_lens: bool = False) -> FilmedClip:
        """Film a clip."""
        rng, middle = np.random.default_rng(clip.seed), np.array([WIDTH / 2, HEIGHT / 2])
        world = self.poses_m[clip.take][clip.first_frame : clip.first_frame + int(SECONDS * RATE_HZ)]
        lengths = np.median(bone_lengths(OP14, world[:, 0]), axis=0)
        world = world * clip.stature_m / float(body_height_m(OP14, lengths))
        extent = max(np.ptp(world[..., 0]), np.ptp(world[..., 2]))
        distance = max(clip.focal_px * 1.75 / 480, 0.55 * extent * clip.focal_px / middle[0] + 0.15 * extent)
        camera = look_at_camera(
            mid_hip(world).mean(axis=(0, 1)),
            distance_m=distance,
            yaw_rad=clip.yaw_rad,
            pitch_rad=np.deg2rad(clip.pitch_deg),
            focal_px=clip.focal_px,
            image_size_px=(WIDTH, HEIGHT),
        )
        truth = (world - camera.position_m) @ camera.camera_from_world_rotmat.T
        px = (
            camera.project(world).px + lasting_noise(rng, (*truth.shape[:-1], 2)) * clip.focal_px * 1.7 / distance / 200
        )
        is_missed = (rng.random(px.shape[:-1]) < 0.05) | ((px < 0) | (px >= 2 * middle)).any(axis=-1)
        px[is_missed] = np.nan
        lens = Lens.assumed(WIDTH, HEIGHT, px.reshape(-1, 2), clip.focal_px if has_lens else None)
        people = range(px.shape[1])
        tracks = [
            Track(
                px[:, person], np.where(is_missed, 0.0, 0.8)[:, person], RATE_HZ, lens, person,
                partner_id=1 - person if len(people) == 2 else None,
            )
            for person in people
        ]  # fmt: skip
        return FilmedClip(clip, tracks, truth, float(camera.position_m[1]))


def lasting_noise(rng: np.random.Generator, shape: tuple[int, ...]) -> Array:
    """Return noise (frame, ...) of deviation 1 px, half of its power white and half lasting for ten frames."""
    white, steps = rng.normal(0, 1, shape), rng.normal(0, 1, shape)
    lasting = np.zeros(shape)
    lasting[0] = steps[0]
    for frame in range(1, shape[0]):
        lasting[frame] = 0.9 * lasting[frame - 1] + np.sqrt(1 - 0.9**2) * steps[frame]
    return 0.7 * (white + lasting)


def reconstruct_clip(
    seen: FilmedClip,
    database: SearchedDatabase,
    camera: StatedCamera | None = None,
    statures_m: Mapping[int, float] | None = None,
) -> Reconstruction:
    """Reconstruct a clip as `pasdedeux reconstruct` does."""
    options = SequenceOptions((Method.NEAREST, Method.FIT), statures_m=statures_m or {})
    return reconstruct_sequence(seen.tracks, database, camera, options)


@dataclass(frozen=True)
class Row:
    """Errors of one person or couple of a clip by method, metres; the expected error of the last, and its evidence."""

    clip: ClipSettings
    is_place: bool
    errors_m: dict[str, float]
    expected_m: float
    evidence: Array
    verdict: str


def people_rows(seen: FilmedClip, reconstruction: Reconstruction, level: Reconstruction | None) -> Iterator[Row]:
    """Yield everybody and the couple of a clip."""
    judged = reconstruction.judged
    methods = {method.name: method.people for method in reconstruction.people.methods} | (
        {} if level is None else {"level": level.people.methods[-1].people}
    )
    methods = {
        "ours": methods.pop("fit_clean"),
        **{name: methods[name] for name in ("nearest", "level") if name in methods},
    }
    for number, reconstructed in enumerate(methods["ours"]):
        person, frames = reconstructed.track.person_id, reconstructed.track.frames
        truth = seen.truth_m[frames, person]
        errors = {
            name: float(root_centred_error_m(people[number].positions_m, truth).mean())
            for name, people in methods.items()
        }
        still = np.broadcast_to((truth - mid_hip(truth)[:, None]).mean(axis=0), truth.shape)
        errors["standing still"] = float(root_centred_error_m(still, truth).mean())
        verdict = judged.people[person]
        yield Row(seen.clip, False, errors, verdict.expected_error_m, verdict.evidence, verdict.verdict.level.value)
    for (first, second), place in judged.places.items():
        true = mid_hip(seen.truth_m[:, second]) - mid_hip(seen.truth_m[:, first])
        between = {name: people[second].root_m - people[first].root_m for name, people in methods.items()}
        between["equal depth"] = between["ours"] * [1.0, 1.0, 0.0]
        errors = {name: float(np.linalg.norm(vectors - true, axis=-1).mean()) for name, vectors in between.items()}
        yield Row(seen.clip, True, errors, place.expected_error_m, place.evidence, place.verdict.level.value)


def main(arguments: Sequence[str] | None = None) -> None:
    """Reconstruct the clips and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--store", type=Path, default=Path(tempfile.gettempdir()) / "pasdedeux-families")
    parser.add_argument("--clips", type=int, default=7)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--pitches", default=",".join(map(str, PITCHES_DEG)))
    parser.add_argument("--families", default=",".join(FAMILIES))
    parser.add_argument("--lens", action="store_true")
    parser.add_argument("--stature", action="store_true")
    parser.add_argument("--no-level", action="store_true")
    asked = parser.parse_args(arguments)
    takes = Takes(asked.data, asked.store)
    # Fits of a few frames are too small for several threads of linear algebra, which wait for each other.
    with threadpool_limits(limits=1):
        say_all(takes, asked)


def say_all(takes: Takes, asked: argparse.Namespace) -> None:
    """Reconstruct the clips, report each, and print the tables."""
    rows: list[Row] = []
    pitches_deg = [float(pitch) for pitch in asked.pitches.split(",")]
    clips = takes.clips(asked.clips, seed=asked.seed, pitches_deg=pitches_deg)
    for family in asked.families.split(","):
        from_others = takes.without(family)
        for clip in (clip for clip in clips if clip.family == family):
            seen = takes.seen(clip, has_lens=asked.lens)
            statures_m = {track.person_id: clip.stature_m for track in seen.tracks[:1]} if asked.stature else {}
            reconstruction = reconstruct_clip(seen, from_others, statures_m=statures_m)
            level = None if asked.no_level else reconstruct_clip(seen, from_others, StatedCamera(0.0), statures_m)
            rows += people_rows(seen, reconstruction, level)
            say(
                f"{family} {clip.take}: "
                + ", ".join(
                    f"{100 * row.errors_m['ours']:.1f} cm ({100 * row.expected_m:.0f} expected, {row.verdict})"
                    for row in rows
                    if row.clip == clip
                )
            )
    for is_place, words in ((False, "pose of each"), (True, "place of one to the other")):
        kind_rows = [row for row in rows if row.is_place == is_place]
        if kind_rows:
            say(f"\n{words}, cm")
            say_errors(kind_rows)
            say_expected(kind_rows)


def say_errors(rows: Sequence[Row]) -> None:
    """Print the mean errors of each family by method."""
    names = list(rows[0].errors_m)
    say(f"| family left out | {' | '.join(names)} | expected |\n|---|{'---|' * (len(names) + 1)}")
    for family in (*dict.fromkeys(row.clip.family for row in rows), "all"):
        family_rows = [row for row in rows if family in ("all", row.clip.family)]
        means = [np.mean([row.errors_m[name] for row in family_rows]) for name in names] + [
            np.mean([row.expected_m for row in family_rows])
        ]
        say(f"| {family} | {' | '.join(f'{100 * mean:.1f}' for mean in means)} |")


def say_expected(rows: Sequence[Row]) -> None:
    """Print the coverage of expected errors, with the constants in use and with those fitted on other families."""
    true, expected = np.array([[row.errors_m["ours"], row.expected_m] for row in rows]).T
    evidence, families = np.array([row.evidence for row in rows]), np.array([row.clip.family for row in rows])
    large = true > LARGE_M * (2 if rows[0].is_place else 1)
    names = np.unique(families)
    if len(names) < 4 or len(rows) < 10 * len(names) or not 0 < np.count_nonzero(large) < len(rows):
        return
    passed = np.array([row.verdict == "pass" for row in rows])
    say(f"in use: AUC of large errors {auc(expected, large):.2f}; pass: {np.mean(passed[large]):.0%} of them,")
    say(f"  {np.mean(passed[~large]):.0%} of the others")
    halves = [np.isin(families, half) for half in combinations(names, len(names) // 2)]
    for words, divisions in (
        ("each family by the others", [[families != name for name in names]]),
        ("half of the families by the other half, and swapped, all ways", [[half, ~half] for half in halves]),
    ):
        predicted = np.array([[*outside(evidence, true, families, chosen)] for chosen in divisions])
        holds = np.mean((predicted[:, 1] <= true) & (true <= predicted[:, 2]), axis=0)
        shares = ", ".join(f"{name} {holds[families == name].mean():.0%}" for name in names)
        score = np.mean([interval_score(true, low, high) for _, low, high in predicted])
        constant = np.mean([interval_score(true, *constants(true, chosen)) for chosen in divisions])
        skill = np.mean([auc(expected, large) for expected, _, _ in predicted])
        say(f"{words}: AUC {skill:.2f}, interval holds in {holds.mean():.0%}")
        say(f"  ({shares}), interval score {100 * score:.1f} (a constant one {100 * constant:.1f})")
    weights = np.round(fitted(evidence, true), 3).tolist()
    say(f"fitted to all: weights {weights}, interval {np.round(parts(evidence, true, families), 2).tolist()}")


def outside(evidence: Array, true: Array, families: Any, chosen: Sequence[Any]) -> Array:
    """Return expected errors and interval ends of all rows (3, row), fitted on other families.

    Args:
        evidence: (row, n).
        true: Errors (row,), metres.
        families: Name of the family of each row (row,).
        chosen: Rows (row,) that the others are judged by: the others of all of these are every row, once.
    """
    predicted = np.full((3, len(true)), np.nan)
    for fit in chosen:
        middle = np.exp(evidence[~fit] @ fitted(evidence[fit], true[fit]))
        predicted[:, ~fit] = middle * np.array([1.0, *parts(evidence[fit], true[fit], families[fit])])[:, None]
    return predicted


INTERVAL = (0.1, 0.9)


def parts(evidence: Array, true: Array, families: Any) -> Array:
    """Return the interval of the error of another family as parts (2,) of the expected error.

    Each family is judged by the others.  The residuals of the logarithms scatter within families and between them; of
    the next family it is Student's t of as many degrees of freedom as there are families less one.
    """
    names = np.unique(families)
    means, squares = np.zeros((2, len(names)))
    for at, name in enumerate(names):
        of_family = families == name
        left = np.log(true[of_family]) - evidence[of_family] @ fitted(evidence[~of_family], true[~of_family])
        means[at], squares[at] = left.mean(), np.sum((left - left.mean()) ** 2)
    within = squares.sum() / (len(true) - len(names))
    between = max(np.var(means, ddof=1) - within * len(names) / len(true), 0.0)
    deviation = np.sqrt(within + between * (1.0 + 1.0 / len(names)))
    return np.asarray(np.exp(means.mean() + deviation * stats.t.ppf(INTERVAL, len(names) - 1)))


def fitted(evidence: Array, true_m: Array) -> Array:
    """Return the weights (n,) of evidence (row, n), 1 first, whose sum is the logarithm of the error to expect (row,).

    Least squares of the logarithms, and a correction: the mean of log-normal values is larger than their median.
    """
    weights, *_ = np.linalg.lstsq(evidence, np.log(true_m), rcond=None)
    weights[0] += 0.5 * np.var(np.log(true_m) - evidence @ weights)
    return np.asarray(weights)


def auc(score: Array, is_large: npt.NDArray[np.bool_]) -> float:
    """Return the AUC of a score for large errors."""
    above = score[is_large][:, None] - score[~is_large]
    return float(np.mean((above > 0) + 0.5 * (above == 0))) if above.size else float("nan")


def interval_score(true: Array, low: Array, high: Array) -> float:
    """Return the interval score of 80 % intervals (Gneiting and Raftery 2007, eq. 43)."""
    missed = np.maximum(low - true, 0.0) + np.maximum(true - high, 0.0)
    return float(np.mean(high - low + missed / INTERVAL[0]))


def constants(true: Array, chosen: Sequence[Any]) -> Array:
    """Return the ends (2, row) of one interval for all rows of the families that are not chosen."""
    fits = np.full((2, len(true)), np.nan)
    for fit in chosen:
        fits[:, ~fit] = np.quantile(true[fit], INTERVAL)[:, None]
    return fits


say: Callable[[str], None] = lambda text: print(text, flush=True)  # noqa: E731, T201

if __name__ == "__main__":
    main()
