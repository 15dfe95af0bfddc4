"""What studies and commands of earlier versions said, and what to say now: one sentence for each old name.

A study key is written with its section, `"chains.old_key"`; a position in a list is left out, and `*` stands for a name
that the user chose (`"chains.variants.*.old_key"`).  A whole section is its name alone.  The value of a key that is no
longer allowed is `"chains.some_key=old_value"`.  Tables and columns are in `storage_schema.renamed`.
"""

from __future__ import annotations

from collections.abc import Sequence
from fnmatch import fnmatchcase

__all__ = ["RENAMED_COMMANDS", "RENAMED_KEYS", "RENAMED_STUDIES", "is_to_leave_out", "renamed_key"]

RENAMED_KEYS: dict[str, str] = {
    "augmentation.solver=descent": "say polished, which comes to the same energy in a third of the time",
    "augmentation.contact_m": "contacts are between surfaces of bodies now: say touch_m, their distance",
    "augmentation.weights.contact_extremity": "it is now called contact_hand",
    "augmentation.weights.contact_mixed": "it is now called contact_hand, as for two hands",
    "augmentation.weights.contact_limb": "it is now called contact_body, as for torsos",
    "augmentation.weights.contact_torso": "it is now called contact_body",
    "augmentation.limits.foot_slide_m": "it is measured by stance now, not by frame: say stance_excursion_m",
    "augmentation.frame_limits.foot_slide_m": "it is measured by stance now, not by frame: say stance_excursion_m",
    "augmentation.grid": "list the scales under augmentation.scales",
    "views.calibrate_sizes": "the ratio of body sizes is always learned: leave it out",
    "seeds.num_hypotheses": "more than the likeliest view of an annotation brought nothing: leave it out",
    "chains.kernel": "it is now called chains.proposal",
    "chains.most_blocks": "it is now called chains.max_blocks",
    "chains.most_invalid_angles": "it is now called physical_prior.max_invalid_angles",
    "chains.guided_*": "guided steps are gone, they covered no more than plain ones: leave it out",
    "chains.reference": "the truncation refers to the seed's own density alone: leave it out",
    "chains.left_out_quantile": "the truncation refers to the seed's own density alone: leave it out",
    "chains.moves*": "whole limbs and people moved as one brought nothing: leave it out",
    "chains.variants.*.moves*": "whole limbs and people moved as one brought nothing: leave it out",
    **dict.fromkeys(
        (
            f"chains.{key}={density}"
            for key in ("densities", "variants.*.density")
            for density in ("agreement", "cartesian", "shape_context")
        ),
        "chains of it covered no more than those of ic: leave it out",
    ),
    "chains.num_ranked": "it belonged to the density shape_context, which is gone: leave it out",
    "chains.variants.*.num_ranked": "it belonged to the density shape_context, which is gone: leave it out",
    "evaluation.num_judged_pairs": "terms of densities are no longer judged (docs/findings.md): leave it out",
    "chains.joint_limits": "limits learned from capture covered no more than the table's: leave it out",
    "chains.variants.*.joint_limits": "limits learned from capture covered no more than the table's: leave it out",
    "chains.variants.*.kernel": "it is now called proposal",
    "chains.variants.*.most_blocks": "it is now called max_blocks",
    "chains.variants.*.most_invalid_angles": "it is now called max_invalid_angles",
    "chains.variants.*.guided_*": "guided steps are gone, they covered no more than plain ones: leave it out",
    "chains.variants.*.reference": "the truncation refers to the seed's own density alone: leave it out",
    "chains.variants.*.left_out_quantile": "the truncation refers to the seed's own density alone: leave it out",
    "reconstruction.identities": "who is who is settled at ingest: say identities of each [[ingest.annotations]]",
    "reconstruction.has_repair": "faults are repaired at ingest: say has_repair of each [[ingest.annotations]]",
    "seeds.alpha": "one value serves every stage now: it is called physical_prior.alpha",
    "evaluation.alpha": "one value serves every stage now: it is called physical_prior.alpha",
    "chains.alpha": "one value serves every stage now: it is called physical_prior.alpha",
    "chains.sigma_p_m": "one value serves every stage now: it is called physical_prior.sigma_p_m",
    "chains.max_invalid_angles": "one value serves every stage now: it is called physical_prior.max_invalid_angles",
    "chains.length_tolerance": "one value serves every stage now: it is called physical_prior.length_tolerance",
    "evaluation.has_unseen_view_sweeps": "noise and missing joints are scored at one level each: leave it out",
    "ingest.*.swap_persons": "files and subjects come in the order of the people: name them in that order",
    "projections.*cluster*": "the published search is gone, the exact one always finds the best: leave it out",
    "evaluation.num_crowd_views": "the topic detector scores who is taken for whom: leave it out",
    "evaluation.has_left_out_clips": "the held-out takes say what it said: leave it out",
    **dict.fromkeys(
        (
            "augmentation.mesh_smoothing_s",
            "evaluation.clip_rate_hz",
            "ingest.virtual_video.yaw_range_deg",
            "ingest.virtual_video.pitch_range_deg",
            "priors.max_frames_per_take",
            "seeds.max_annotations",
            "seeds.max_frames_per_take",
            "views.contact_distance_m",
            "views.*_root_distance_m",
            "views.*_weight",
            "views.size_deviation",
        ),
        "no study ever changed it, and it is a constant now: leave it out",
    ),
    "seeds.is_refined": "growth is no longer refined (it brought 5.25 to 5.10 cm for twice the time): leave it out",
}
"""Old study key, or key=value, to one sentence with the new name or what became of it.

The key itself, as it was given, stands before the sentence and is not said again.
"""

RENAMED_STUDIES: dict[str, str] = {
    "ablation": "its densities covered no more than ic and are gone (docs/findings.md); the nearest is coverage",
    "density": "terms of densities are no longer judged (docs/findings.md)",
}
"""Old study that shipped to one sentence on what became of it."""

RENAMED_COMMANDS: dict[str, str] = {}
"""Old command of `pasdedeux` to one sentence with the new one."""


def renamed_key(path: Sequence[str | int], value: object = None) -> str | None:
    """Return the sentence for an old key, or for an old value of a key; None when the key was never another."""
    name = ".".join(str(step) for step in path if not str(step).isdigit())
    for old, sentence in RENAMED_KEYS.items():
        if fnmatchcase(name, old) or (isinstance(value, str) and fnmatchcase(f"{name}={value}", old)):
            return sentence
    return None


def is_to_leave_out(path: Sequence[str | int]) -> bool:
    """Tell whether a key is gone without another in its place."""
    return (renamed_key(path) or "").endswith("leave it out")
