"""CVAT's XML (1.1): skeletons in single images, and tracks of skeletons with key frames.

A track is a person.  Its key frames are annotated; between them, CVAT interpolates linearly.  Points that are `outside`
are missing, occluded points have half the confidence.  Labels of points are names of joints.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from xml.etree import ElementTree
from xml.sax.saxutils import quoteattr

import numpy as np

from pasdedeux.errors import FormatError
from pasdedeux.formats.file_format import AnnotationFormat
from pasdedeux.formats.poses2d.annotated_frames import (
    MAX_IMAGE_PX,
    AnnotatedFrames,
    KeypointStatus,
    get_keypoint_layout,
)
from pasdedeux.formats.poses2d.detections import detections_of_joints, join_detections
from pasdedeux.formats.poses2d.image_names import FramePlace, places_of_names
from pasdedeux.formats.text import decode, parse_integer, parse_number, shorten
from pasdedeux.skeletons.layouts import KeypointLayout

OCCLUDED = 0.5
"""Confidence of an occluded point, as of a labelled but hidden one of COCO."""

Point = tuple[float, float, float, float]


def read_cvat(
    data: bytes | str, sequence_id: str = "sequence", layout: str | KeypointLayout = "auto"
) -> AnnotatedFrames:
    """Read the skeletons of CVAT for video or for images.

    Raises:
        FormatError: It is not XML, declares entities (no tool writes them), or has names of joints of no layout.
    """
    root = parse_xml(data, "CVAT file")
    if root.tag != "annotations":
        raise FormatError(f"this CVAT file begins with <{shorten(root.tag)}>, not <annotations>")
    rows: dict[tuple[str, int, int | str], dict[str, Point]] = {}
    sizes: dict[str, tuple[int, int]] = {}
    for index, track in enumerate(root.iterfind("track")):
        person = parse_integer(track.get("id", str(index)), f"track {index}: id")
        for skeleton in track.iterfind("skeleton"):
            frame = parse_integer(skeleton.get("frame", ""), f"track {index}: frame")
            _add(rows, ("", frame, person), skeleton, is_key=skeleton.get("keyframe", "1") == "1")
    images = list(root.iterfind("image"))
    has_numbers = True
    places = _places(images)
    for image, place in zip(images, places, strict=True):
        people = list(image.iterfind("skeleton"))
        groups = [parse_integer(person.get("group_id") or "0", f"frame {place[1]}: group_id") for person in people]
        is_numbered = len(set(groups)) == len(groups) and all(groups)
        has_numbers &= is_numbered or len(people) < 2
        for order, skeleton in enumerate(people):
            _add(rows, (*place, groups[order] if is_numbered else order), skeleton, is_key=True)
        if image.get("width") and image.get("height"):
            sizes[place[0]] = _size(image.get("width", ""), image.get("height", ""), f"frame {place[1]}")
    stated = root.find("meta//original_size")
    if stated is not None:
        sizes[""] = _size(stated.findtext("width", ""), stated.findtext("height", ""), "annotation 0: original_size")
    if not rows:
        raise FormatError("this CVAT file is empty: it holds no skeletons")
    detections = detections_of_joints(rows)
    frames = join_detections(detections, sequence_id=sequence_id, layout=layout, sizes_px=sizes, is_strict=True)
    return replace(frames, has_identities=has_numbers)


def write_cvat(frames: AnnotatedFrames) -> str:
    """Write annotations of one film as tracks of CVAT; annotated and detected frames become key frames."""
    names = get_keypoint_layout(frames.layout).keypoint_names
    sizes = set(frames.image_size_px.values())
    lines = ['<?xml version="1.0" encoding="utf-8"?>', "<annotations>", "  <version>1.1</version>"]
    if len(sizes) == 1:
        ((width, height),) = sizes
        size = f"<original_size><width>{width}</width><height>{height}</height></original_size>"
        lines.append(f"  <meta><task>{size}</task></meta>")
    status = np.full(frames.confidence.shape, KeypointStatus.ANNOTATED) if frames.status is None else frames.status
    for person in np.unique(frames.person_id).tolist():
        lines.append(f'  <track id="{person}" label="person" source="manual">')
        for row in np.flatnonzero(frames.person_id == person).tolist():
            are_key = (status[row] >= KeypointStatus.DETECTED).astype(int)
            lines.append(f'    <skeleton frame="{frames.frame[row]}" keyframe="{are_key.max()}" z_order="0">')
            points = zip(names, frames.keypoints_px[row], frames.confidence[row], are_key, strict=True)
            for name, (x, y), sure, is_key in points:
                outside, place = int(sure == 0), "0.00,0.00" if sure == 0 else f"{x:.2f},{y:.2f}"
                hidden = int(0 < sure <= OCCLUDED)
                lines.append(
                    f'      <points label={quoteattr(name)} keyframe="{is_key}" outside="{outside}" '
                    f'occluded="{hidden}" points="{place}"/>'
                )
            lines.append("    </skeleton>")
        lines.append("  </track>")
    return "".join(f"{line}\n" for line in (*lines, "</annotations>"))


def parse_xml(data: bytes | str, what: str) -> ElementTree.Element:
    """Return the root of an XML text.

    Raises:
        FormatError: It is not well formed, or declares a document type, whose entities may expand without bound or read
            files.
    """
    text = decode(data, what)
    at = text.find("<!DOCTYPE")
    if at >= 0 or "<!ENTITY" in text:
        line = text.count("\n", 0, max(at, 0)) + 1
        raise FormatError(f"line {line}: this {what} declares a document type or entities, which are not read")
    try:
        return ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise FormatError(f"line {error.position[0]}: this {what} is not valid XML: {error}") from None


def _add(
    rows: dict[tuple[str, int, int | str], dict[str, Point]],
    key: tuple[str, int, int | str],
    skeleton: ElementTree.Element,
    *,
    is_key: bool,
) -> None:
    where = f"frame {key[1]}"
    if key in rows:
        raise FormatError(f"{where}: person {key[2]} appears twice")
    points: dict[str, Point] = {}
    for point in skeleton.iterfind("points"):
        name = point.get("label", "")
        words = point.get("points", "").split(",")
        if len(words) != 2:
            raise FormatError(f"{where}: '{shorten(name)}' has no place x,y")
        if name in points:
            raise FormatError(f"{where}: '{shorten(name)}' twice for person {key[2]}")
        x, y = (parse_number(word.strip(), f"{where}: {axis}") for word, axis in zip(words, "xy", strict=True))
        sure = 0.0 if point.get("outside") == "1" else OCCLUDED if point.get("occluded") == "1" else 1.0
        is_own = is_key and point.get("keyframe", "1") == "1"
        points[name] = (x, y, sure, KeypointStatus.ANNOTATED if is_own else KeypointStatus.INTERPOLATED)
    if skeleton.get("outside") != "1" and any(point[2] > 0 for point in points.values()):
        rows[key] = points


def _places(images: Sequence[ElementTree.Element]) -> list[FramePlace]:
    """Return video and frame of each image from the names, if they are different, else from the ids."""
    names = [image.get("name", "") for image in images]
    if len(set(names)) == len(names) and all(names):
        places: Mapping[str, FramePlace] = places_of_names(names)
        return [places[name] for name in names]
    return [("", parse_integer(image.get("id", ""), f"annotation {index}: id")) for index, image in enumerate(images)]


def _size(width: str, height: str, where: str) -> tuple[int, int]:
    sides = [parse_integer(side, f"{where}: image side", 1, MAX_IMAGE_PX) for side in (width, height)]
    return sides[0], sides[1]


CVAT = AnnotationFormat(
    name="cvat",
    suffixes=(".xml",),
    recognises=lambda start: start.text.startswith("<") and "<annotations" in start.text,
    read_file=read_cvat,
)
"""CVAT for video and for images 1.1."""
