"""What draws are good for: lifting annotations by retrieval, completing occluded joints, in-betweens, and baselines."""

from pasdedeux.completion.baselines import lift_by_ik, sample_naively
from pasdedeux.completion.draw_index import DrawIndex, Nearest
from pasdedeux.completion.fit import FitOptions, fit_pair, fit_people, pooled_lengths
from pasdedeux.completion.in_betweens import InBetweenOptions, fill_between, straight_between
from pasdedeux.completion.neighbours import Neighbours, nearest_by_interaction, nearest_rigid
from pasdedeux.completion.occlusion import Completion, blend_onto, complete_pair
from pasdedeux.completion.retrieval import Retrieval, RetrievalOptions, image_residual, retrieve

__all__ = [
    "Completion",
    "DrawIndex",
    "FitOptions",
    "InBetweenOptions",
    "Nearest",
    "Neighbours",
    "Retrieval",
    "RetrievalOptions",
    "blend_onto",
    "complete_pair",
    "fill_between",
    "fit_pair",
    "fit_people",
    "image_residual",
    "lift_by_ik",
    "nearest_by_interaction",
    "nearest_rigid",
    "pooled_lengths",
    "retrieve",
    "sample_naively",
    "straight_between",
]
