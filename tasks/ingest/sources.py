"""Source files before any work: found, hashed, and refused while it is cheap to do so."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pasdedeux.errors import FormatError, InputError
from pasdedeux.formats import (
    SourceMotion,
    check_layout,
    count_amc_frames,
    guess_format,
    guess_metres_per_unit,
    read_amc,
    read_asf,
    read_bvh,
    read_bvh_header,
    read_positions_npz,
    read_rotation_rows,
)
from pasdedeux.skeletons import Skeleton
from pasdedeux.skeletons.layouts import LAYOUTS, Layout, find_layout, joints_missing
from storage_schema import SourceCredit
from tasks.ingest.known_sources import CMU_CREDIT, known_source
from tasks.ingest.parameters import CommonOptions, PersonOptions
from tasks.stage import SourceFile

__all__ = ["PersonSource", "credit_of", "find_person", "layout_named", "load_file", "read_person"]

Tables = Mapping[Any, Mapping[str, Any]]
"""For each working skeleton the changed entries of its table."""

NOT_STATED = "not stated"
OWN_FILES = "files given in the study"
LEAST_UNIT_SURENESS = 0.3


@dataclass(frozen=True)
class LoadedFile:
    """A file's bytes with its path and digest."""

    file: SourceFile
    data: bytes


@dataclass(frozen=True)
class PersonSource:
    """One person's file after the checks: what the shard will need, and how long it is.

    Args:
        files: The motion file first, then its skeleton file if it has one.
        format: bvh, asf_amc, rotation_rows or positions_npz.
        layout: Name of the layout.
        rate_hz: True rate of the file.
        metres_per_unit: Length of its unit.
        up_axis: x, y, z or auto (told from the motion).
        num_frames: Frames in the file.
    """

    files: tuple[SourceFile, ...]
    format: str
    layout: str
    rate_hz: float
    metres_per_unit: float
    up_axis: str
    num_frames: int


def load_file(path: Path) -> LoadedFile:
    """Read and hash a file.

    Raises:
        InputError: It is not there or cannot be read.
    """
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise InputError(f"file {path} does not exist") from None
    except OSError as error:
        raise InputError(f"file {path} cannot be read: {error.strerror}") from None
    return LoadedFile(file=SourceFile(path=str(path), sha256=hashlib.sha256(data).hexdigest()), data=data)


def layout_named(name: str, joint_names: tuple[str, ...], mappings: Mapping[str, Tables]) -> Layout:
    """Return the layout of a study for these joints: "auto" tells it from them; the study's mappings are applied.

    Raises:
        InputError: No known layout fits, or the name is neither known nor one of the study's mappings.
    """
    if name == "auto":
        layout = find_layout(joint_names)
        if layout is None:
            shown = ", ".join(joint_names[:12]) + (", ..." if len(joint_names) > 12 else "")
            near = joints_missing(joint_names)
            hint = f"; the nearest is {near[0].name}, which also needs {', '.join(near[1])}" if near else ""
            raise InputError(
                f"its joints fit none of the known layouts ({', '.join(LAYOUTS)}){hint}; joints: {shown}; "
                "name a layout, or write one under [ingest.mappings]"
            )
    elif name in LAYOUTS:
        layout = LAYOUTS[name]
    elif name in mappings:
        layout = Layout(name=name, meaning="of the study", signature=frozenset(), tables={})
    else:
        raise InputError(f"layout '{name}' is not known; known: {', '.join([*LAYOUTS, *mappings])}")
    return layout.with_tables(mappings[layout.name]) if layout.name in mappings else layout


def find_person(path: Path, take: CommonOptions, person: PersonOptions, mappings: Mapping[str, Tables]) -> PersonSource:
    """Find and check one person's file.

    Raises:
        InputError: With the file's name in front: missing, mangled, unknown joints, a bone of length zero, or
            something that must be said in the study and is not.
    """
    loaded = load_file(path)
    try:
        kind = guess_format(loaded.data) if take.format == "auto" else take.format
        kind = "asf_amc" if kind == "amc" else kind
        if kind not in {"bvh", "asf_amc", "rotation_rows", "positions_npz"}:
            raise InputError(f"this is a file of the kind '{kind}', not a motion of one person")
        skeleton = _skeleton_file(path, kind, person)
        head = _head(kind, loaded, skeleton)
        layout_name = person.layout or take.layout
        layout = layout_named(layout_name, head.source.skeleton.joint_names, mappings)
        known = known_source(path.name, layout.name)
        rate = person.rate_hz or take.rate_hz or known.rate_hz or head.source.rate_hz
        if rate is None:
            raise InputError("the file states no frame rate; set rate_hz for this take")
        scale = person.metres_per_unit or take.metres_per_unit or known.metres_per_unit or _scale(head.source)
        check_layout(head.source.to_motion(metres_per_unit=scale, rate_hz=rate), layout)
    except InputError as error:
        raise type(error)(f"{path.name}: {error}") from None
    return PersonSource(
        files=(loaded.file,) if skeleton is None else (loaded.file, skeleton.file),
        format=kind,
        layout=layout_name if layout_name != "auto" else layout.name,
        rate_hz=rate,
        metres_per_unit=scale,
        up_axis=person.up_axis or take.up_axis,
        num_frames=head.num_frames,
    )


def read_person(kind: str, data: bytes, skeleton: bytes | None) -> SourceMotion:
    """Read one person's motion.

    Raises:
        FormatError: The file is mangled.
    """
    if kind == "bvh":
        return read_bvh(data)
    if kind == "asf_amc":
        return read_amc(data, read_asf(_needed(skeleton)))
    if kind == "rotation_rows":
        return read_rotation_rows(data, _needed(skeleton))
    return read_positions_npz(data).to_source_motion()


def credit_of(layout: str, licence: str | None, credit: str | None) -> SourceCredit:
    """Return licence and credit of a take: what the study says, else what is known of the source."""
    is_cmu = layout.startswith("cmu_")
    if is_cmu and licence is None and credit is None:
        return CMU_CREDIT
    return SourceCredit(
        name=CMU_CREDIT.name if is_cmu else OWN_FILES,
        licence=licence or (CMU_CREDIT.licence if is_cmu else NOT_STATED),
        credit=credit or (CMU_CREDIT.credit if is_cmu else NOT_STATED),
    )


@dataclass(frozen=True)
class _Head:
    """A file's skeleton with one frame of rest, and its length."""

    source: SourceMotion
    num_frames: int


_heads: dict[tuple[str, str, str], _Head] = {}
_MAX_HEADS = 2000


def _head(kind: str, loaded: LoadedFile, skeleton: LoadedFile | None) -> _Head:
    """Check a file as far as that is cheap; remembered by digest, because a study is planned several times in a run."""
    key = (kind, loaded.file.sha256, skeleton.file.sha256 if skeleton else "")
    if key not in _heads:
        if len(_heads) >= _MAX_HEADS:
            _heads.clear()
        _heads[key] = _read_head(kind, loaded.data, skeleton.data if skeleton else None)
    return _heads[key]


def _read_head(kind: str, data: bytes, skeleton: bytes | None) -> _Head:
    if kind == "bvh":
        header = read_bvh_header(data)
        return _Head(
            source=_rest(header.skeleton, header.rest_offsets, header.rate_hz, None), num_frames=header.num_frames
        )
    if kind == "asf_amc":
        asf = read_asf(_needed(skeleton))
        num_frames = count_amc_frames(data, asf)
        return _Head(source=_rest(asf.skeleton, asf.rest_offsets, None, asf.metres_per_unit), num_frames=num_frames)
    source = read_person(kind, data, skeleton)
    rest = _rest(source.skeleton, source.rest_offsets, source.rate_hz, source.metres_per_unit)
    return _Head(source=rest, num_frames=source.num_frames)


def _rest(
    skeleton: Skeleton, rest_offsets: npt.NDArray[np.float64], rate_hz: float | None, metres_per_unit: float | None
) -> SourceMotion:
    still = np.zeros((1, skeleton.num_joints, 4))
    still[..., 3] = 1.0
    return SourceMotion(
        skeleton=skeleton,
        rest_offsets=rest_offsets,
        root_translation=np.zeros((1, 3)),
        local_unitquat=still,
        end_sites=frozenset(),
        rate_hz=rate_hz,
        metres_per_unit=metres_per_unit,
    )


def _skeleton_file(path: Path, kind: str, person: PersonOptions) -> LoadedFile | None:
    """Return the skeleton file of a kind that needs one.

    The ASF of 60_01.amc is 60.asf beside it; the template of rows of rotations is template.bvh beside them or above.
    """
    if kind not in {"asf_amc", "rotation_rows"}:
        return None
    if person.skeleton is not None:
        return load_file(person.skeleton)
    if kind == "rotation_rows":
        for folder in (path.parent, path.parent.parent):
            if (folder / "template.bvh").is_file():
                return load_file(folder / "template.bvh")
        raise InputError(
            "rows of rotations need their BVH template, and there is no template.bvh beside the file or above; "
            "set `skeleton` under `persons` of this take"
        )
    beside = path.with_name(path.stem.rpartition("_")[0] + ".asf")
    if not beside.is_file():
        raise InputError(f"its skeleton {beside.name} is not beside it; set `skeleton` under `persons` of this take")
    return load_file(beside)


def _scale(rest: SourceMotion) -> float:
    scale, sureness, reason, _ = guess_metres_per_unit(rest)
    if sureness < LEAST_UNIT_SURENESS:
        raise InputError(f"its length unit cannot be told ({reason}); set metres_per_unit for this take")
    return scale


def _needed(skeleton: bytes | None) -> bytes:
    if skeleton is None:
        raise FormatError("this file needs a skeleton file beside it")
    return skeleton
