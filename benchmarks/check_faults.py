"""Measure how many planted faults `pasdedeux check` finds in clips of duets and salsa, and its false alarms.

    python -m benchmarks.check_faults DATA                  200 clips of 5 s, every kind of fault in each
    python -m benchmarks.check_faults DATA --clips 40       fewer
    python -m benchmarks.check_faults DATA --drift 100      contacts that drift, in variants of so many of the clips

DATA is a folder with CMU's salsa, `cmu_salsa_bvh`, the folder of PASDEDEUX_DATA.  Half of the clips are of built-in
duets in drawn styles and bodies, half are windows of salsa.  A family is a dance or a take.  For each kind the table
has a limit chosen on every second family, half way between untouched and planted clips.  It has the shares of found
faults and of false alarms on the other families, by this limit and by the declared limits.  A fault is found if a
figure of its kind is past its first limit.  Captured clips in which a bone flips faster than a body can are faulty
before anything is planted: they are left out of the table, and counted below it.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from itertools import chain
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import numpy.typing as npt

from flows.console.context import say
from flows.console.display import format_table
from pasdedeux.augmentation import Augmenter, Source
from pasdedeux.augmentation import quality as against
from pasdedeux.augmentation.variations import Variation
from pasdedeux.choreography.duets import DUETS, draw_styles, make_duet
from pasdedeux.evaluation.motion_check import HELD, QUALITY_LIMITS, CheckedMotion
from pasdedeux.figure import Figure, complaints, limits_of
from pasdedeux.formats.rigs.working_poses import derive_working_poses
from pasdedeux.interaction.surfaces import surface_gaps
from pasdedeux.plausibility.capsules import capsule_model
from pasdedeux.plausibility.capture import JUDGED, check_capture
from pasdedeux.skeletons import BODY22
from pasdedeux.skeletons.layouts import LAYOUTS
from tasks.ingest.checking import pair_up, read_checked_motion

Array = npt.NDArray[np.float64]
Plant = Callable[[Array, float, np.random.Generator], Array]
CLIP_S = 5.0
SEED = 0
MAX_TURN_RAD_S = np.deg2rad(2000.0)
"""No bone turns faster: the fastest spin of a figure skater has 342 turns a minute, 2,050 degrees a second."""


@dataclass(frozen=True)
class SampleClip:
    """Two people (frame, 2, 22, 3), metres, y up, on their floor."""

    family: str
    number: int
    people_m: Array
    rate_hz: float

    @property
    def is_faulty(self) -> bool:
        """Return whether a bone turns faster between two frames than a body can, a fault of the capture."""
        parents, children = np.transpose(BODY22.bones)
        bones = self.people_m[:, :, children] - self.people_m[:, :, parents]
        bones /= np.maximum(np.linalg.norm(bones, axis=-1, keepdims=True), 1e-9)
        turns = 2.0 * np.arcsin(np.clip(np.linalg.norm(np.diff(bones, axis=0), axis=-1) / 2.0, 0.0, 1.0))
        return bool(turns.max(initial=0.0) * self.rate_hz > MAX_TURN_RAD_S)


def offset_floor(people_m: Array, rate_hz: float, generator: np.random.Generator) -> Array:
    """Lift or lower one person by 10 to 40 cm."""
    planted = people_m.copy()
    planted[:, generator.integers(2), :, 1] += generator.choice([-1, 1]) * generator.uniform(0.1, 0.4)
    return planted


def tilt_floor(people_m: Array, rate_hz: float, generator: np.random.Generator) -> Array:
    """Tilt the whole scene by 5 to 15 degrees about a level axis through its middle on the floor."""
    angle, heading = np.deg2rad(generator.uniform(5.0, 15.0)), generator.uniform(0.0, 2.0 * np.pi)
    middle = people_m.mean(axis=(0, 1, 2)) * [1.0, 0.0, 1.0]
    axis = np.array([np.cos(heading), 0.0, np.sin(heading)])
    points = people_m - middle
    along = (points @ axis)[..., None] * axis
    return np.asarray(middle + along + np.cos(angle) * (points - along) + np.sin(angle) * np.cross(axis, points))


def slide_feet(people_m: Array, rate_hz: float, generator: np.random.Generator) -> Array:
    """Slide one person back and forth over the floor, at a median speed of 0.4 to 1 m/s."""
    speed, heading, period_s = generator.uniform(0.4, 1.0), generator.uniform(0.0, 2.0 * np.pi), 2.0
    phase = 2.0 * np.pi * np.arange(len(people_m)) / rate_hz / period_s
    way = speed * np.sqrt(2.0) * period_s / (2.0 * np.pi) * np.sin(phase)
    planted = people_m.copy()
    planted[:, generator.integers(2)] += way[:, None, None] * np.array([np.cos(heading), 0.0, np.sin(heading)])
    return planted


def jump_at_first(people_m: Array, rate_hz: float, generator: np.random.Generator) -> Array:
    """Shift one person in the first frame by 0.3 to 1 m, or replace the pose by one of another moment at the origin."""
    planted, person = people_m.copy(), generator.integers(2)
    if generator.random() < 0.5:
        heading = generator.uniform(0.0, 2.0 * np.pi)
        planted[0, person] += generator.uniform(0.3, 1.0) * np.array([np.cos(heading), 0.0, np.sin(heading)])
    else:
        planted[0, person] = people_m[len(people_m) // 2, person]
        planted[0, person] -= planted[0, person, 0] * [1.0, 0.0, 1.0]
    return planted


def swap_people(people_m: Array, rate_hz: float, generator: np.random.Generator) -> Array:
    """Exchange the two people from a random frame on."""
    start = int(len(people_m) * generator.uniform(0.2, 0.8))
    return np.concatenate([people_m[:start], people_m[start:, ::-1]])


def resize(people_m: Array, rate_hz: float, generator: np.random.Generator) -> Array:
    """Scale one person and the path by 1.4 to 2.5 or its inverse, like a wrong unit."""
    planted = people_m.copy()
    planted[:, generator.integers(2)] *= generator.uniform(1.4, 2.5) ** generator.choice([-1, 1])
    return planted


def push_together(people_m: Array, rate_hz: float, generator: np.random.Generator) -> Array:
    """Shift B towards A in every frame until they are 15 to 20 cm inside each other a fifth of the time, or nearly."""
    radii, wanted = capsule_model(BODY22).radii_of(people_m), generator.uniform(0.15, 0.20)
    way = (people_m[:, 0, 0] - people_m[:, 1, 0]) * [1.0, 0.0, 1.0]
    way = way / np.maximum(np.linalg.norm(way, axis=-1, keepdims=True), 0.05)
    step = max(1, round(rate_hz / 10.0))
    deepest, planted = -np.inf, people_m
    for shift in np.arange(0.0, 2.0, 0.03):
        pushed = people_m.copy()
        pushed[:, 1] += shift * way[:, None]
        depth = float(np.percentile(-surface_gaps(pushed[::step], radii, BODY22).closest_m, 80.0))
        if depth > deepest:
            deepest, planted = depth, pushed
        if depth >= wanted:
            break
    return planted


FAULTS: Mapping[str, Plant] = {
    "floor offset": offset_floor,
    "floor tilt": tilt_floor,
    "foot slide": slide_feet,
    "first-frame jump": jump_at_first,
    "swapped bodies": swap_people,
    "wrong size": resize,
    "penetration": push_together,
}


def duet_clips(count: int) -> Iterator[SampleClip]:
    """Yield windows of every built-in duet of two people, each in another style and on other bodies."""
    names = [name for name, dance in DUETS.items() if dance.num_people == 2]
    generator = np.random.default_rng(SEED)
    styles = {name: draw_styles(2, -(-count // len(names)), generator) for name in names}
    for number in range(count):
        name = names[number % len(names)]
        motions = make_duet(name, duration_s=2.0 * CLIP_S, **styles[name][number // len(names)]).motions
        people_m = np.stack([derive_working_poses(motion, LAYOUTS["body22"]).body22_m for motion in motions], axis=1)
        yield _window(name, number, people_m, motions[0].rate_hz)


def salsa_clips(data: Path, count: int) -> Iterator[SampleClip]:
    """Yield windows of every take of salsa."""
    files = sorted((data / "cmu_salsa_bvh").glob("*.bvh"))
    for at, motion in enumerate(motions := pair_up(dict.fromkeys(files, 1))):
        take = read_checked_motion(motion)
        for number in range(at, count, len(motions)):
            yield _window(f"salsa {motion.name}", number, take.people_m, take.rate_hz)


def _window(family: str, number: int, people_m: Array, rate_hz: float) -> SampleClip:
    length = round(CLIP_S * rate_hz)
    start = int(np.random.default_rng([SEED, number]).integers(len(people_m) - length))
    return SampleClip(family, number, people_m[start : start + length], rate_hz)


def drift(people_m: Array, source: Source, generator: np.random.Generator) -> Array:
    """Turn a touching arm by 5 to 15 cm at its hand, or shift the touching person, for a second or more."""
    contacts = source.contacts()
    frame, place = np.nonzero(contacts.is_held)
    at = generator.integers(len(frame))
    person, bone = divmod(int(contacts.bones()[frame[at], place[at], generator.integers(2)]), BODY22.num_joints)
    away = 2.0 * (np.arange(len(people_m)) - frame[at]) / source.rate_hz
    share, far = np.exp(-(away**4)), generator.uniform(0.05, 0.15)
    heading = generator.normal(size=3)
    planted, name = people_m.copy(), BODY22.joint_names[bone]
    if not name.endswith(("elbow", "wrist")):
        heading[1] = 0.0
        planted[:, person] += (share * far)[:, None, None] * heading / np.linalg.norm(heading)
        return planted
    shoulder, elbow, wrist = BODY22.indices([f"{name.split('_')[0]}_{part}" for part in ("shoulder", "elbow", "wrist")])
    arm = people_m[:, person, [elbow, wrist]] - people_m[:, person, [shoulder]]
    axis = np.cross(arm[:, 1], heading)
    axis = (axis / np.linalg.norm(axis, axis=-1, keepdims=True))[:, None]
    angle = (share * far / np.linalg.norm(arm[:, 1], axis=-1))[:, None, None]
    along = (arm * axis).sum(axis=-1, keepdims=True) * axis
    turned = along + np.cos(angle) * (arm - along) + np.sin(angle) * np.cross(np.broadcast_to(axis, arm.shape), arm)
    planted[:, person, [elbow, wrist]] = people_m[:, person, [shoulder]] + turned
    return planted


KINDS: Mapping[str, tuple[str, ...]] = {
    "floor offset": ("floor_gap_m", "sunk_m", "floating_share", "floor_spread_m"),
    "floor tilt": ("tilt_rad", "floor_spread_m", "upright_share"),
    "foot slide": ("skate_m_s",),
    "first-frame jump": ("start_jump_m", "jump_m"),
    "swapped bodies": ("jump_m", "speed_m_s"),
    "wrong size": ("stature_factor",),
    "penetration": ("penetration_m", "trunk_m"),
    "contact drift": (
        *("worst_contact_m", "contact_drift_p95_m"),
        *("contact_drift_extremity_m", "contact_drift_mixed_m", "contact_drift_body_m"),
    ),
}
"""Figures that can find each kind; a limit is chosen for the first."""


AGAINST_LIMITS = QUALITY_LIMITS | limits_of(HELD)


@dataclass(frozen=True)
class Measured:
    """A clip, planted or not: the value of each kind's first figure, and the figures past a limit."""

    family: str
    values: Mapping[str, float]
    past: frozenset[str]


def measure_clip(clip: SampleClip) -> Measured:
    """Measure the capture of a clip."""
    people = check_capture(clip.people_m, rate_hz=clip.rate_hz)
    limits = {name: both for name, both in limits_of(JUDGED).items() if name != "body_difference_m"}
    return _measured(clip.family, [(person, JUDGED) for person in people], limits)


def _measured(
    family: str, measured: Sequence[tuple[object, Mapping[str, Figure]]], limits: Mapping[str, tuple[float, float]]
) -> Measured:
    values: dict[str, float] = {}
    past: set[str] = set()
    for measured_clip, figures in measured:
        for first in (first for first, *_ in KINDS.values() if first in figures):
            value = getattr(measured_clip, first)
            values[first] = np.fmax(values.get(first, np.nan), np.nan if value is None else value)
        own_limits = {name: both for name, both in limits.items() if name in figures}
        past |= {figure.name for figure, _, _ in complaints(measured_clip, figures, own_limits)}
    return Measured(family, values, frozenset(past))


def measure_all(clip: SampleClip, *, with_drift: bool) -> dict[str, tuple[Measured, Measured]]:
    """Measure a clip untouched and with each kind of fault; the seed is the number of the clip and the kind."""
    untouched, changed = measure_clip(clip), {}
    for at, (kind, plant) in enumerate(FAULTS.items()):
        planted = plant(clip.people_m, clip.rate_hz, np.random.default_rng([SEED, clip.number, at]))
        changed[kind] = untouched, measure_clip(replace(clip, people_m=planted))
    both = measure_drift(clip, np.random.default_rng([SEED, clip.number])) if with_drift else None
    return changed | ({"contact drift": both} if both is not None else {})


def measure_drift(clip: SampleClip, generator: np.random.Generator) -> tuple[Measured, Measured] | None:
    """Measure a variant of a clip and the same with a drifting contact; None without contacts."""
    original = CheckedMotion(clip.family, clip.people_m, clip.rate_hz)
    source = original.source
    if not original.contacts.is_held.any():
        return None
    scale = np.ones((2, BODY22.num_joints))
    scale[generator.integers(2)] = generator.uniform(0.85, 1.15)
    variant = Augmenter(source).solve([Variation("variant", scale)])[0].positions_m
    drifts = []
    for people in (variant, drift(variant, source, generator)):
        quality, held, _ = CheckedMotion("variant", people, source.rate_hz).held_against(original)
        drifts.append(_measured(clip.family, [(quality, against.FIGURES), (held, HELD)], AGAINST_LIMITS))
    return drifts[0], drifts[1]


def row(kind: str, untouched: Sequence[Measured], planted: Sequence[Measured]) -> tuple[str, ...]:
    """Return a line of the table of a kind, judged on every second family."""
    first, families = KINDS[kind][0], sorted({clip.family for clip in untouched})
    chosen_on = set(families[::2])
    ends = [
        np.nanpercentile([clip.values[first] for clip in some if clip.family in chosen_on], percent)
        for some, percent in ((untouched, 97.5), (planted, 2.5))
    ]
    limit = float(np.mean(ends))
    judged = [[clip for clip in some if clip.family not in chosen_on] for some in (planted, untouched)]
    by_choice = [np.mean([clip.values[first] > limit for clip in some]) for some in judged]
    declared = [np.mean([bool(clip.past & set(KINDS[kind])) for clip in some]) for some in judged]
    every = [np.mean([bool(clip.past & set(KINDS[kind])) for clip in some]) for some in (planted, untouched)]
    stated = {**AGAINST_LIMITS, **limits_of(JUDGED)}[first][0]
    shares = (f"{100 * share:.1f} %" for share in (*by_choice, *declared, *every))
    return (kind, str(len(planted)), f"{first} {limit:.3g}", *shares, f"{stated:g}")


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--clips", type=int, default=200)
    parser.add_argument("--drift", type=int, default=100)
    parser.add_argument("--workers", type=int, default=2)
    given = parser.parse_args()
    half = given.clips // 2
    step = max(1, given.clips // max(given.drift, 1))
    by_kind: dict[str, list[tuple[Measured, Measured]]] = {kind: [] for kind in KINDS}
    with ProcessPoolExecutor(given.workers, get_context("forkserver")) as pool:
        clips = list(chain(duet_clips(half), salsa_clips(given.data, half)))
        faulty = list(pool.map(measure_clip, [clip for clip in clips if clip.is_faulty]))
        good = [(at, clip) for at, clip in enumerate(clips) if not clip.is_faulty]
        for job in [pool.submit(measure_all, clip, with_drift=given.drift > 0 == at % step) for at, clip in good]:
            for kind, both in job.result().items():
                by_kind[kind].append(both)
    rows = [row(kind, *zip(*both, strict=True)) for kind, both in by_kind.items() if both]
    untouched, drifting = ([clip for clip, _ in by_kind[kind]] for kind in ("floor offset", "contact drift"))
    heads = ("kind", "clips", "limit chosen", "found", "accused", "found, declared", "accused", "found, all", "accused")
    say(format_table((*heads, "declared"), rows, text_columns=(0, 2)))
    for what, some in (("untouched captures", untouched), ("untouched variants", drifting), ("faulty clips", faulty)):
        names = [name for clip in some for name in clip.past]
        each = ", ".join(f"{name} {names.count(name)}" for name in sorted(set(names)))
        say([f"{sum(bool(clip.past) for clip in some)} of {len(some)} {what} are past a limit: {each}"])


if __name__ == "__main__":
    main()
