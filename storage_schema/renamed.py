"""Tables and columns of earlier versions, and what to say when a reference or a reader names one: one sentence each."""

from __future__ import annotations

__all__ = ["RENAMED_COLUMNS", "RENAMED_TABLES"]

RENAMED_TABLES: dict[str, str] = {
    "pose_prior": "where bones of prior takes pointed is no longer kept: no density used it",
    "codebook": "the published search and its clusters are gone: the exact search always finds the best",
}
"""Old table to one sentence with the new name or what became of it."""

RENAMED_COLUMNS: dict[str, str] = {
    "variant_quality.foot_slide_m": "it is measured by stance now: stance_excursion_m",
    "variant_frames.foot_slide_m": "it is measured by stance now: stance_excursion_m",
    "variant_quality.scale_a": "it is the first number of uniform_scale",
    "variant_quality.scale_b": "it is the second number of uniform_scale",
    "takes.licence": "licences are beside the data, as they stand today: `show`, CREDITS.txt of exports, datasets",
    "takes.credit": "credits are beside the data, as they stand today: `show`, CREDITS.txt of exports, datasets",
    "chain_states.kernel_state": "it is now called proposal_state",
    "seeds.gap_m": "it is now called image_distance_m",
}
"""Old column, with its table (`"draws.old_column"`), to one sentence with the new name or what became of it."""
