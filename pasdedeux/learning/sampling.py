"""Sample bodies and their motion from a trained model: p(B_s) p(q'_B | B_s) p(q'_A | q'_B) [Li et al. 2024, eq. 1]."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pasdedeux.arrays import Array
from pasdedeux.augmentation import Source
from pasdedeux.augmentation.source import complete_scales
from pasdedeux.errors import InputError
from pasdedeux.learning.key_frames import KeyFrames
from pasdedeux.learning.model import VariantModel, VariantRequest, check_topology


@dataclass(frozen=True)
class Sample:
    """A body and a motion that a model gives for it, as decoded: its bones are not exact yet.

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
        generator: Gives whatever is drawn; the same one gives the same motion.
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
        key_frames.check(source)
        scale = key_frames.bone_scale(source) if scale is None else scale
    plain = np.ones((2, source.skeleton.num_joints))
    given = plain if scale is None else np.stack([plain[0], scale])
    # Checked before anything is decoded: two people, scales of this skeleton.
    request = VariantRequest(take_id or source.name, source, complete_scales(source, given[None])[0])
    drawn = model.generate(source, generator, scale=scale, key_frames=key_frames)
    if drawn is not None:
        return Sample(complete_scales(source, drawn[0][None])[0], drawn[1])
    if scale is None:
        raise InputError(f"{model.name} draws no bodies: scales must be given")
    return Sample(request.bone_scale, model.predict(request))
