"""Sample bodies and their motion from a trained model: p(B_s) p(q'_B | B_s) p(q'_A | q'_B) [Li et al. 2024, eq. 1]."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.augmentation import Augmenter, Source, UserContact, Variant
from pasdedeux.augmentation.source import complete_scales
from pasdedeux.augmentation.variations import Variation
from pasdedeux.errors import InputError
from pasdedeux.learning.key_frames import KeyFrames
from pasdedeux.learning.mesh_refine import refine, window_problems
from pasdedeux.learning.model import VariantModel, VariantRequest, check_topology

NUM_STEPS = 2
"""Steps of the mesh that clean a sampled motion."""


@dataclass(frozen=True)
class Sample:
    """A body and its motion as decoded by a model: its bones are not exact yet.

    Args:
        bone_scale: Scales (2, J), those of A 1, the root's following the legs.
        motion_m: Motion of both (T, 2, J, 3), metres.
    """

    bone_scale: Array
    motion_m: Array


def sample_motion(
    model: VariantModel,
    source: Source,
    generator: np.random.Generator,
    *,
    scale: Array | None = None,
    key_frames: KeyFrames | None = None,
    take_id: str = "",
) -> Sample:
    """Sample a motion of both people for a body of B.

    Args:
        model: A trained model; one that draws nothing gives the motion that it predicts for given scales.
        source: The template, T frames of two people.
        generator: Source of all draws; the same one gives the same motion.
        scale: Scales of B's bones (J,); without them those of the key frames, or a draw from the model's p(B_s).
        key_frames: Poses that B's motion goes through before its bones are made exact; A's motion follows from B's.
        take_id: Name of the take, by which a model may know it from training.

    Raises:
        InputError: The take has another skeleton or not two people, a key frame is outside of it, the model has no
            p(B_s) and no scales are given, or gives A's motion for no motion of B and key frames are.
    """
    check_topology(model, source)
    if key_frames is not None:
        if not model.takes_key_frames:
            raise InputError(f"{model.name} takes no key frames: it gives A's motion for no motion of B")
        key_frames.check(source.name, source.num_frames, source.skeleton)
        scale = key_frames.bone_scale(source) if scale is None else scale
    plain = np.ones((2, source.skeleton.num_joints))
    given = plain if scale is None else np.stack([plain[0], scale])
    # Check before decoding: two people, scales of this skeleton.
    request = VariantRequest(take_id or source.name, source, complete_scales(source, given[None])[0])
    drawn = model.generate(source, generator, scale=scale, key_frames=key_frames)
    if drawn is not None:
        return Sample(complete_scales(source, drawn[0][None])[0], drawn[1])
    if scale is None:
        raise InputError(f"{model.name} draws no bodies: scales must be given")
    return Sample(request.bone_scale, model.predict(request))


class VariantSampler:
    """A trained model and a take, prepared for any number of variants, which are measured like the solver's.

    Args:
        model: The trained model.
        source: The template.
        take_id: Name of the take, by which the model may know it from training.
        contacts: Contacts stated for the take, which replace the detected ones.
        key_frames: Poses that B goes through.

    Raises:
        InputError: As `sample_motion`; the take is of another skeleton than `body22`, the solver's.
    """

    def __init__(
        self,
        model: VariantModel,
        source: Source,
        *,
        take_id: str,
        contacts: Sequence[UserContact] = (),
        key_frames: KeyFrames | None = None,
    ) -> None:
        check_topology(model, source)
        self._model, self._take_id, self._key_frames = model, take_id, key_frames
        plain = np.ones((source.num_people, source.skeleton.num_joints))
        self._request = VariantRequest(take_id, source, plain, contacts=tuple(contacts))
        self._augmenter = Augmenter(source, user_contacts=contacts)
        self._parts = window_problems(self._request)

    def sample(self, variant_id: str, generator: np.random.Generator, scale: Array | None = None) -> Variant:
        """Sample a variant: decoded, then two steps of the mesh, which make bones exact and bring contacts back.

        Args:
            variant_id: Its name.
            generator: Source of all draws.
            scale: Scales of B's bones (22,); see `sample_motion`.
        """
        source = self._request.source
        drawn = sample_motion(
            self._model, source, generator, scale=scale, key_frames=self._key_frames, take_id=self._take_id
        )
        request = replace(self._request, bone_scale=drawn.bone_scale)
        refined = refine(request, self._parts, drawn.motion_m, NUM_STEPS, self._key_frames)
        return self._augmenter.assess(
            Variation(variant_id, drawn.bone_scale),
            refined.motion_m,
            squared_residual=refined.squared_residual,
            num_iterations=NUM_STEPS,
        )
