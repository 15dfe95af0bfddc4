"""Proposals guided by an annotation: a step towards what it shows, or away from it, with both densities known.

The way from a pair to an annotation is what would make the pair look like it under the annotation's own view: bones
turn towards the image, roots shift and backbones swing, depth and bone lengths stay as far as the image lets them.  A
guided step goes a part of that way, plus noise.

A step draws some auxiliary variables: the blocks that move and log z, evenly between -t and t, both independently of
where the chain stands, and the annotation e with a probability q(e | x) that falls with its distance from the pair's
projection.  With the way r_e(x), the step is

    x' = x + d,    d normal with mean (1 - z) r_e(x) and deviation sqrt(z) sigma:

towards the annotation where z < 1, to z times the distance, and away from it where z > 1.  The step back is the one by
-d with the same blocks and annotation and with 1 / z, whose log is as likely.  Eq. 10 (Yin et al. 2018) therefore takes

    q(e | x') N(-d; (1 - 1/z) r_e(x'), sigma^2 / z) / (q(e | x) N(d; (1 - z) r_e(x), sigma^2 z)),

all of it computed at both ends.  For every value of the auxiliary variables the steps forth with (e, z) and back with
(e, 1/z) balance in detail, so their mixture, and the mixture with any other kernel in fixed shares, leaves the target
as it is: the annotation need not be summed over.  For a fixed goal the ratio is z^n, that of the stretch move of
Goodman and Weare (2010), with n numbers that move.  The published method has no such kernel.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from pasdedeux.cameras import pair_frame
from pasdedeux.errors import InputError
from pasdedeux.sampling.growth_kernels import fill_residuals
from pasdedeux.sampling.guided_kernels import move_by, way_to_image
from pasdedeux.sampling.likelihood import AnnotatedPairs
from pasdedeux.sampling.parameters import LENGTH_INDICES, NUM_JOINTS, PairChart
from pasdedeux.sampling.proposals import GaussianBlocks, Local, Proposed, Resolved, Scales
from pasdedeux.skeletons import PAIR17

__all__ = ["Guided", "GuidedStep", "Guides"]

Array = npt.NDArray[np.float64]

TIGHTNESS = 0.16
"""Weight of a squared error in depth against one in the image, as in growth."""

_ORDER, _PARENTS = np.array(PAIR17.order), np.array(PAIR17.parents)
_NECK = PAIR17.index("neck")


@dataclass(frozen=True)
class Guides:
    """Annotations that may guide the steps of the chains of one seed.

    Args:
        annotated: Annotated pairs with their views; every entry is one guide.
        chart: Parameters round the seed.
        width_m: Width of the preference for annotations near the pair: of a normal density in the root mean square
            distance of the joints in the image, metres; inf prefers none.

    Raises:
        InputError: The width is not positive.
    """

    annotated: AnnotatedPairs
    chart: PairChart
    width_m: float = 0.03

    def __post_init__(self) -> None:
        """Check the width."""
        if not self.width_m > 0.0:
            raise InputError(f"the width of guided proposals must be positive, found {self.width_m:g}")

    @cached_property
    def images(self) -> Array:
        """Centred images (entry, person=2, joint=17, 2), metres."""
        points = self.annotated.points_m
        return np.ascontiguousarray(points - points.mean(axis=(1, 2), keepdims=True))

    @cached_property
    def _tables(self) -> tuple[Array, Array, Array]:
        flat = self.images.reshape(len(self.images), 2 * NUM_JOINTS, 2)
        directions = np.ascontiguousarray(self.annotated.directions)
        return directions, np.ascontiguousarray(np.swapaxes(flat, 1, 2)), (flat**2).sum(axis=(1, 2))

    def log_chances(self, pair_m: Array, axes: Array) -> Array:
        """Return log q(e | x), (entry,), of a pair (2, 17, 3) with the axes (3, 3) of its local frame."""
        count = len(self.images)
        if np.isinf(self.width_m):
            return np.full(count, -np.log(count))
        points = pair_m.reshape(2 * NUM_JOINTS, 3)
        points = np.ascontiguousarray((points - points.mean(axis=0)).T)
        residual = np.empty(count)
        fill_residuals(points, points @ points.T, axes, *self._tables, residual)
        height = -0.5 * (residual / self.width_m) ** 2
        height -= height.max()
        return np.asarray(height - np.log(np.exp(height).sum()))

    def way(self, parameters: Array, pair_m: Array, axes: Array, entry: int, blocks: npt.NDArray[np.int64]) -> Array:
        """Return the way r_e(x) of some blocks to an entry, (block, 6): of a bone only the first two numbers count.

        Args:
            parameters: Parameters (108,).
            pair_m: The pair that they give, (2, 17, 3), metres.
            axes: Axes of its local frame, (3, 3).
            entry: The annotation.
            blocks: Blocks that move (see `block_indices`).
        """
        towards = axes @ self.annotated.directions[entry]
        lengths = self.chart.lengths_m.copy()
        lengths[:, 1:] *= 1.0 + parameters[LENGTH_INDICES]
        way = np.empty((len(blocks), 6))
        way_to_image(
            parameters,
            pair_m,
            towards / max(float(np.linalg.norm(towards)), 1e-300),
            self.images[entry],
            lengths,
            self.chart.directions,
            self.chart.axes,
            _ORDER,
            _PARENTS,
            _NECK,
            blocks,
            TIGHTNESS,
            way,
        )
        return way


@dataclass(frozen=True)
class GuidedStep:
    """A guided step with everything that was drawn for it.

    Args:
        step: d above, (block, 6): rotation vector and shift of a root, the two rotations of a bone.
        blocks: Blocks that move, (block,).
        entry: The annotation that guides.
        log_z: log z.
        deviation: sigma of each number, (block, 6); 0 for those that do not move.
    """

    step: Array
    blocks: npt.NDArray[np.int64]
    entry: int
    log_z: float
    deviation: Array

    def back(self) -> GuidedStep:
        """Return the step back."""
        return replace(self, step=-self.step, log_z=-self.log_z)


@dataclass(frozen=True)
class Guided:
    """A mixture: steps of `plain`, and guided ones in a fixed share.

    Guided steps move what the mixture of `plain` moves together, with its deviations and learned factors, but leave
    bone lengths alone.

    Args:
        plain: The other steps.
        guides: What guides.
        share: Share of guided steps, from 0 to 1.
        stretch: t above: log z lies between -t and t.

    Raises:
        InputError: `share` is out of range, `stretch` is not positive, or a deviation of `plain` is 0.
    """

    plain: GaussianBlocks
    guides: Guides
    share: float = 0.3
    stretch: float = 0.3

    def __post_init__(self) -> None:
        """Check the numbers."""
        if not 0.0 <= self.share <= 1.0 or not (0.0 < self.stretch < np.inf):
            raise InputError(f"guided steps: share {self.share:g} and stretch {self.stretch:g} cannot be")
        deviations = (self.plain.root_rotation_rad, self.plain.root_position_m, self.plain.joint_rotation_rad)
        if not min(deviations) > 0.0:
            raise InputError(f"guided steps need positive scales of rotations and shifts, found {deviations}")

    @property
    def scales(self) -> Scales:
        """Learned factors."""
        return self.plain.scales

    def with_scales(self, scales: Scales) -> Guided:
        """Return the same proposal with other learned factors."""
        return replace(self, plain=self.plain.with_scales(scales))

    def look_round(self, parameters: Array) -> Local | None:
        """Return what the other steps must know of a point."""
        return self.plain.look_round(parameters)

    def __call__(self, parameters: Array, local: Local | None, rng: np.random.Generator) -> Proposed:
        """Propose a step from parameters (108,)."""
        if rng.random() >= self.share:
            return self.plain(parameters, local, rng)
        move = self.plain.mixture.draw(rng)
        blocks = np.array(move.blocks, dtype=np.int64)
        log_z = float(rng.uniform(-self.stretch, self.stretch))
        deviation = self._deviations(blocks) * self.plain.scales.of(move)[:, None]
        pair, axes, log_chance = self._at(parameters)
        cumulated = np.cumsum(np.exp(log_chance))
        entry = min(int(np.searchsorted(cumulated, rng.random() * cumulated[-1], side="right")), len(cumulated) - 1)
        way = self.guides.way(parameters, pair, axes, entry, blocks)
        noise = rng.standard_normal((len(blocks), 6))
        step = -np.expm1(log_z) * way + np.exp(0.5 * log_z) * deviation * noise
        there = parameters.copy()
        if not move_by(there, blocks, step, NUM_JOINTS):
            # The turn back would not be the turn's own negative; what is never proposed need not balance.
            return Proposed(parameters, log_correction=-np.inf)
        moves = deviation > 0.0
        # `log_density` of the step forth, whose way and noise are known.
        forth = log_chance[entry] - 0.5 * float((noise[moves] ** 2).sum()) - 0.5 * np.count_nonzero(moves) * log_z
        back = GuidedStep(step, blocks, entry, log_z, deviation).back()
        correction = self.log_density(there, back) - float(forth)
        resolve: Callable[[], Resolved] | None = None
        if self.plain.bias is not None:

            def look() -> Resolved:
                return Resolved(correction, self.look_round(there))

            resolve = look
        return Proposed(there, correction, resolve)

    def log_density(self, parameters: Array, guided: GuidedStep) -> float:
        """Return log q(e | x) N(d; (1 - z) r_e(x), sigma^2 z) of a step from parameters (108,), up to a constant."""
        pair, axes, log_chance = self._at(parameters)
        way = self.guides.way(parameters, pair, axes, guided.entry, guided.blocks)
        moves = guided.deviation > 0.0
        missed = (guided.step + np.expm1(guided.log_z) * way)[moves] / guided.deviation[moves]
        squared = float((missed**2).sum()) * np.exp(-guided.log_z)
        return float(log_chance[guided.entry] - 0.5 * squared - 0.5 * np.count_nonzero(moves) * guided.log_z)

    def _deviations(self, blocks: npt.NDArray[np.int64]) -> Array:
        """Return the standard deviation of each number of each block, (block, 6); 0 for those that do not move."""
        found = np.zeros((len(blocks), 6))
        is_root = blocks % NUM_JOINTS == 0
        found[is_root, :3], found[is_root, 3:] = self.plain.root_rotation_rad, self.plain.root_position_m
        found[~is_root, :2] = self.plain.joint_rotation_rad
        return found

    def _at(self, parameters: Array) -> tuple[Array, Array, Array]:
        """Return a point's pair (2, 17, 3), the axes of its frame and log q(e | x)."""
        pair = self.guides.chart.positions_fast(parameters)
        axes = np.ascontiguousarray(pair_frame(pair).axes)
        return pair, axes, self.guides.log_chances(pair, axes)
