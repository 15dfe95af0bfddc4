"""Match a track of 2D keypoints to a database: estimate scale and place of the person, and search candidates."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from pydantic import Field

from pasdedeux.arrays import Array, Integers, plain
from pasdedeux.errors import InputError
from pasdedeux.projections.database import Database
from pasdedeux.projections.published import Clusters, PublishedIndex
from pasdedeux.projections.scale import Placement, ScaleReference, place_track, refine_placement
from pasdedeux.projections.search import Neighbours, ProjectionIndex, build_index
from pasdedeux.reconstruction.proportions import estimate_proportions, retarget_image
from pasdedeux.reconstruction.rays import straighten_rays
from pasdedeux.reconstruction.tracks import Track
from pasdedeux.reconstruction.yaw import refine_yaws
from pasdedeux.settings import Settings
from pasdedeux.skeletons import OP14

MIN_JOINTS = 4
"""Frames that show fewer joints are interpolated."""
_NUM_PLACEMENTS = 4
"""Rounds of search; each one but the last refines scale and place."""
_SCALE_WINDOW_S = 1.5
"""Length of the window over which the median of a track's scale is taken."""
_MODEL_ERROR_M = 0.012
"""Residual in the image that estimated proportions, scale and lens leave, even with exact keypoints."""


class Method(StrEnum):
    """How a candidate is chosen for each frame, and processed further."""

    NEAREST = "nearest"
    PUBLISHED = "published"
    WINDOW = "window"
    VITERBI = "viterbi"
    FIT = "fit"


class ReconstructionOptions(Settings):
    """Settings of the reconstruction of a track."""

    num_candidates: int = Field(50, ge=1, le=1000, description="Projections kept per frame for the choice over time")
    has_own_proportions: bool = Field(True, description="Bone lengths are estimated per person, else the reference's")
    metres_per_pixel: float | None = Field(
        None, gt=0, description="Scale of the image at the person where it is known (a measured camera)"
    )
    min_noise_m: float = Field(_MODEL_ERROR_M, gt=0, description="The image is never believed better than this")
    trust_per_misfit: float = Field(
        2.0, gt=0, description="A retrieved bone is trusted to this many times the misfit of the retrieval"
    )


@dataclass(frozen=True)
class Searcher:
    """A database prepared for search under one camera."""

    database: Database
    index: ProjectionIndex
    reference: ScaleReference
    published: PublishedIndex | None = None
    """Index of the method `published`; None where the database has no clusters."""
    source_row: Integers | None = None
    """Row of the original database for each pose (row,), if poses were laid down; see `lying`."""

    @classmethod
    def of(cls, database: Database, clusters: Clusters | None = None) -> Searcher:
        """Build index and scale reference; with the clusters of the database also the published index."""
        published = None if clusters is None else PublishedIndex(database, clusters)
        return cls(database, build_index(database), ScaleReference.of(database), published)

    @property
    def methods(self) -> tuple[Method, ...]:
        """Methods that can run over this database."""
        return tuple(method for method in Method if method is not Method.PUBLISHED or self.published is not None)

    def pitched(self, pitch_rad: float) -> Searcher:
        """Return a searcher of the same poses for a camera of another pitch."""
        camera = replace(self.database.camera, pitch_rad=pitch_rad)
        if camera == self.database.camera:
            return self
        clusters = None if self.published is None else self.published.clusters
        return replace(Searcher.of(replace(self.database, camera=camera), clusters), source_row=self.source_row)


@dataclass(frozen=True)
class Matches:
    """Result of the search for a track.

    Args:
        neighbours: Candidates (frame, k).
        query_m: Joints of each frame (frame, 14, 2), metres about the mid-hip, own proportions; NaN where not seen.
        weights: Weights (frame, 14) of the joints; all 0 in frames to interpolate.
        placement: Scale and place used in the search; pixels with y up about the principal point, rays straightened.
        towards_camera: Unit direction (frame, 3) from the mid-hip to the camera, camera axes.
        proportions: Length of each bone (14,) as a multiple of the reference body's.
        yaw_steps: Yaw of each candidate (frame, k) in steps of the database.
    """

    neighbours: Neighbours
    query_m: Array
    weights: Array
    placement: Placement
    towards_camera: Array
    proportions: Array
    yaw_steps: Array


def match_track(searcher: Searcher, track: Track, options: ReconstructionOptions | None = None) -> Matches:
    """Estimate scale and place of a track, and find the candidates of each frame.

    Rays are straightened first, as if the camera turned to the person, because the database's camera looks straight at
    the body.

    Raises:
        InputError: No frame shows `MIN_JOINTS` joints, or its size cannot be estimated.
    """
    options = options or ReconstructionOptions()
    centred = (track.keypoints_px - np.array(track.lens.principal_point_px)) * np.array([1.0, -1.0])
    is_seen = (track.confidence > 0).sum(axis=1) >= MIN_JOINTS
    weights = np.where(is_seen[:, None], track.confidence, 0.0)
    if not is_seen.any():
        raise InputError(f"no frame of the track shows {MIN_JOINTS} joints of the person; nothing to search for")
    window = odd_window(_SCALE_WINDOW_S, track.rate_hz)
    scale = options.metres_per_pixel
    first = place_track(centred, weights, searcher.reference, window=window, metres_per_pixel=scale)
    straight, towards = straighten_rays(plain(centred), first.mid_hip_px, track.lens.focal_px)
    placement = place_track(straight, weights, searcher.reference, window=window, metres_per_pixel=scale)
    proportions = np.ones(OP14.num_joints)
    for round_number in range(_NUM_PLACEMENTS):
        image_m = placement.to_metres(straight)
        is_last = round_number == _NUM_PLACEMENTS - 1
        neighbours = searcher.index.search(
            retarget_image(image_m, proportions), weights, num_neighbours=options.num_candidates if is_last else 1
        )
        if not is_last:
            matched = _projection_of(searcher.database, neighbours)
            if options.has_own_proportions:
                proportions = estimate_proportions(image_m, weights, matched)
                # Dividing by the inverse gives the match the proportions of the person, so that both scales compare.
                matched = retarget_image(matched, 1.0 / proportions)
            placement = refine_placement(
                straight, weights, matched, window=window, previous=placement, metres_per_pixel=scale
            )
    # Yaw steps of the database are coarse: refine the yaw of each candidate, and sort by the distances that remain.
    neighbours, yaw_steps = refine_yaws(searcher.database, neighbours, retarget_image(image_m, proportions), weights)
    query = np.where(weights[..., None] > 0, image_m, np.nan)
    return Matches(neighbours, query, weights, placement, towards, proportions, yaw_steps)


def odd_window(seconds: float, rate_hz: float) -> int:
    """Return an odd number of frames, at least 3, that last about as long."""
    return max(3, round(seconds * rate_hz)) | 1


def _projection_of(database: Database, neighbours: Neighbours) -> Array:
    """Return the projections (frame, 14, 2) of the best match of each frame; NaN where there is none."""
    row, yaw = neighbours.row[:, 0], neighbours.yaw_index[:, 0]
    turned = database.turned(np.maximum(row, 0), yaw)
    projected = np.array(database.camera.project(turned), dtype=np.float64)
    projected[row < 0] = np.nan
    return projected
