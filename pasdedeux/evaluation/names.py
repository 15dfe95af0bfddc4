"""What the names of methods and metrics mean, in words for readers who do not know the code."""

from __future__ import annotations

import re
from collections.abc import Iterable
from functools import cache

_METHODS = {
    "interaction_mesh": ("interaction mesh", "deforms the motion so that spatial relations of both people are kept"),
    "naive_fk": ("plain forward kinematics", "the source's joint angles on the new bones: the baseline"),
    "copy": ("copy of the source", "the source unchanged: a baseline"),
    "ridge_scale": ("ridge regression on scales", "linear in the bone scales, fitted for each take"),
    "ridge_adapted": ("adapted ridge regression", "the same, adapted to variants of the test take with near scales"),
    "solver": ("the solver", "the converged variant itself, which models approximate: a bound"),
    "real_halves": ("real halves", "one half of the real clips beside the other: chance level, a bound"),
    "strangers": ("strangers", "one person of a clip and one of another interaction: a baseline"),
    "augmented_by_solver": ("augmented by the solver", "trained on takes and their variants by the solver"),
    "augmented_by_model": ("augmented by the model", "trained on takes and as many variants sampled from a model"),
    "generated": ("generated motion", "sampled from a trained model"),
    "without_augmentation": ("without augmentation", "trained on the same takes alone: a baseline"),
    "last_pose_held": ("last pose held", "the last known pose in every frame: a baseline"),
    "largest_class": ("largest class", "the most frequent class for every clip: a baseline"),
    "mesh_refine": ("predicted, then refined", "another model's prediction, refined by the interaction mesh"),
    "paper_cvae": ("the published network", "a conditional variational autoencoder as in Li et al. 2024"),
    "actor_like": ("ACTOR, adapted", "a transformer conditioned on classes of scales, as adapted by Li et al. 2024"),
    "action2motion_like": ("Action2motion, adapted", "a recurrent network conditioned on classes of scales, likewise"),
    "nearest": ("nearest pose", "frame by frame the pose of the database whose image is nearest: the baseline"),
    "viterbi": ("best path", "the most likely sequence of candidates over all frames"),
    "published": (
        "published search",
        "the published way: 10 projections of each of 5 clusters, then the window rule, on the database's own body",
    ),
    "window": ("window rule", "the published rule over the exact search: the candidate that fits four frames before"),
    "fit": ("fit to the image", "the best path, then optimised until its image is the given one"),
    "live": ("live", "online, with a latency of six frames"),
    "best_of_50": ("best of 50", "the best of the 50 nearest candidates, chosen by ground truth: a bound"),
    "level": ("level camera", "the last method again, as if the camera were level: a baseline"),
    "standing_still": ("standing still", "the mean true pose in every frame: says how much people move"),
    "equal_depth": ("equal depth", "both people at the same distance from the camera: a baseline"),
    "truth": ("ground truth", "the captured motion itself"),
    "heaviest_hypothesis": ("likeliest view", "the view with the greatest weight"),
    "best_hypothesis": ("best of all views", "the hypothesis nearest to the true view: a bound"),
    "mean_view": ("mean view", "the same view for every image: the baseline"),
    "ic": ("interaction coordinates", "chains that compare distances between people's joints with annotations"),
    "cartesian": ("Cartesian", "chains that compare the places of joints with annotations"),
    "shape_context": ("shape context", "chains that compare shape contexts with annotations"),
    "unbiased": ("unbiased steps", "the first density with steps that do not follow velocities"),
    "our_default": ("our default", "the target and the steps that studies have by default"),
    "our_default_from_grown": ("our default from grown pairs", "the same, from chains that start at grown pairs"),
    "prior_only": ("prior alone", "chains that sample joint limits and bone lengths without annotations: the baseline"),
    "grown_seeds": ("grown pairs", "annotations lifted from the seeds nearest to them, step by step"),
    "real_frames": ("real frames", "as many captured pairs as there are draws: a bound"),
    "selected_pairs": ("selected pairs", "the draws and grown pairs that differ most"),
    "random_pairs": ("random pairs", "as many draws and grown pairs at random: a baseline"),
    "nearest_annotation": ("nearest annotation", "the most similar image among those used, without any 3D: a baseline"),
    "fitted": ("fitted draws", "mean of the nearest draws, fitted to the image"),
    "over_time": ("fitted over time", "with other frames of the video as one reconstruction from the draws"),
    "blended": ("blended draws", "the nearest draws, aligned with the visible joints"),
    "blended_10": ("ten blended draws", "the same with the ten nearest draws alone"),
    "median": ("median of draws", "joint-wise median of the nearest draws"),
    "neighbours": ("mean of draws", "mean of the nearest draws"),
    "nearest_draw": ("nearest draw", "the one draw nearest to the image: a baseline"),
    "mean_pair": ("mean pair", "mean of all draws, whatever the image: a baseline"),
    "naive_sampling": ("naive sampling", "independent random poses instead of chains: a baseline"),
    "lifting": ("lifting alone", "the published lifting of one image without draws: a baseline"),
    "lifting_ik": ("lifting with limits", "the same, with joints kept within their limits"),
    "draws": ("along draws", "a path of draws between both ends"),
    "straight": ("straight line", "linear interpolation between both ends: the baseline"),
    "detector": ("as a detector sees it", "joints missing, junk, people in any order"),
    "noise_alone": ("noise alone", "the same video with the same noise and nothing missing: the baseline"),
}
"""Words and a sentence of each method."""
_METRICS = {
    "larger": {
        "as_good_as_real_frames_D_C": ("as good as real frames, joint by joint", "real frames with the same coverage"),
        "as_good_as_real_frames_D_I": ("as good as real frames, by interaction", "real frames with the same coverage"),
        "as_good_as_real_frames_D_S": ("as good as real frames, by shape", "real frames with the same coverage"),
        "expected_correlation": ("expected against true", "correlation of expected and true errors"),
        "coverage": ("coverage of real clips", "share of real neighbourhoods with a clip inside"),
        "recognised": ("recognised", "share of clips whose interaction a classifier of real clips recognises"),
        "accuracy": ("accuracy", "share of clips whose interaction is recognised"),
    },
    "smaller": {
        "lifted_D_C": ("distance of lifted pairs", "Cartesian distance from the true pair"),
        "in_between_lifted_error": ("error between lifted pairs", "joint error of frames between lifted ones"),
        "person_distance_error": ("error of the distance", "error of the distance of the two people"),
        "relative_depth_error": ("error of the depth", "error of the depth between the two people"),
        "hand_contact_drift": ("drift of hands and feet in contact", "contact drift of hands and feet"),
        "body_contact_drift": ("drift of bodies in contact", "contact drift of everything else"),
        "estimated_gap": ("estimated gap", "distance to the optimum as the solver estimates it"),
        "sample_gap": ("measured gap", "distance to the optimum, on a sample"),
        "error_root_kept": ("joint error", "mean distance of joints from ground truth about the mid-hip"),
        "error_root_removed": ("joint error, turned", "the same after the root's rotation was removed"),
        "error_scale_free": ("joint error, scaled", "the same after one scale, which a single camera does not see"),
        "jitter": ("jitter", "mean second difference from frame to frame"),
        "pair_distance_error": ("error of the distance", "error of the distance of the two people"),
        "pair_depth_error": ("error of the depth", "error of the depth between the two people"),
        "pair_place_error": ("error of the place", "error of the relative position of the two people"),
        "camera_pitch_error": ("error of the camera's pitch", "how far the estimated pitch is from the true one"),
        "image_residual": (
            "keypoints from the take",
            "median distance of a film's keypoints from its take's joints",
        ),
        "leave_one_out_d_I": ("leave-one-out distance", "distance of an image that was not used to the nearest draw"),
        "coverage_D_C": ("coverage", "mean distance from a real pair to the nearest draw"),
        "coverage_of_a_set_D_C": ("coverage by a set", "the same with as many pairs of every set"),
        "coverage_D_I": ("coverage by interaction", "the same by interaction coordinates"),
        "coverage_D_S": ("coverage by shape", "the same by shape contexts"),
        "draw_to_nearest_real_D_C": ("realism of draws", "distance from a draw to the nearest real pair"),
        "lifted_pair_error": ("error of lifted pairs", "joint error, distance and depth between people included"),
        "expected_error": ("expected error of lifted pairs", "the same, estimated without ground truth"),
        "lifted_person_error": ("error of lifted people", "joint error of each person about their own root"),
        "occluded_joint_error": ("error of completed joints", "distance of hidden joints from their true position"),
        "in_between_error": ("error in between", "joint error of frames that were filled in"),
        "view_error": ("error of the view", "angle between the estimated and the true direction to the camera"),
        "E_r_of_best_baseline": (
            "share of the best baseline's E_r",
            "100 % is that of the best of copy, kinematics and ridge",
        ),
        "validation_fall": (
            "fall of validation",
            "by how much the last segment of training brought the smallest validation error down",
        ),
        "contact_error": ("contact error", "deviation of contacts from their distance in the source"),
        "energy_gap": ("energy gap", "excess of the mesh's energy over that of the solver's answer"),
        "foot_slide": ("slide of feet", "mean horizontal displacement of standing feet in a frame"),
        "KID": (
            "KID",
            "unbiased kernel distance of distributions, times 1000; of few clips it can be strongly negative",
        ),
        "FID": ("FID", "Fréchet distance of distributions, biased for few clips"),
        "JME": ("JME", "joint error of predicted motion in place"),
        "AME": ("AME", "joint error of predicted poses aligned with the true ones"),
        "E_r": ("joint error E_r", "mean joint distance from the true variant"),
        "E_b": ("bone error E_b", "mean error of predicted bone lengths"),
        "JPD": ("JPD", "error of distances of key pairs; the solver pins those, which favours what is like it"),
        "PWD": ("PWD", "error of distances of all joints of one to all of the other, weighted by 1 / d^2"),
        "identity_switches_per_minute": ("identity switches a minute", "how often a track changes person"),
    },
    "": {
        "log_prior": ("log prior", "log density of poses under the prior, images aside"),
        "expected_interval_share": ("errors inside 80 %", "share of true errors within their 80 % interval"),
        "diversity": ("diversity", "mean distance of features of two clips; good where it is that of real ones"),
        "multimodality": ("multimodality", "mean distance of features of two motions of one take at the same time"),
        "clock_offset": ("offset of the clocks", "time of the captured motion when the film begins"),
        "clock_rate": ("rate of the clocks", "seconds of the captured motion in a second of film"),
        "density": ("density", "mean number of real neighbourhoods that a clip lies in; about 1 for real ones"),
    },
}
"""Words and a sentence of each metric that is not declared as a figure, by which values are better."""
_ENDINGS = {"mean": ", mean", "median": ", median", "p90": ", 90 %", "p95": ", 95 %", "worst": ", worst"}
_ENDINGS |= {"min": ", least", "max": ", most", "clean": ", cleaned up"}
_ENDINGS |= {"first_seed": " from the first seed", "and_grown_seeds": " and grown pairs"}
"""What is said after a name for what ends it."""


def in_words(name: str) -> str:
    """Return a method's or metric's name as people say it; of unknown ones the words of the name.

    >>> in_words("hand_contact_drift_p95"), in_words("cartesian_and_grown_seeds"), in_words("new_score")
    ('drift of hands and feet in contact, 95 %', 'Cartesian and grown pairs', 'new score')
    """
    base, *endings = _parts(name)
    words = known[0] if (known := _known(base)) else re.sub(r"(?<=[a-z0-9])_(?=[a-z0-9])", " ", base)
    return "".join([words, *endings])


def meanings(names: Iterable[str]) -> tuple[tuple[str, str, str], ...]:
    """Return name, words and a sentence for each of these names that is known, sorted."""
    bases = sorted({_parts(name)[0] for name in names})
    return tuple((base, *found) for base in bases if (found := _known(base)) is not None)


def is_bound(method: str) -> bool:
    """Tell whether a method knows the ground truth, so that it is no answer but a bound for answers."""
    return method in {
        "truth",
        "solver",
        "real_halves",
        "real_frames",
        "standing_still",
        "best_hypothesis",
        "best_of_50",
    }


def better_sign(metric: str) -> int:
    """Return 1 where larger values of a metric are better, -1 where smaller are, 0 where that is not known."""
    _, _, better = _metrics().get(_parts(metric)[0], ("", "", ""))
    return {"larger": 1, "smaller": -1}.get(better, 0)


@cache
def _metrics() -> dict[str, tuple[str, str, str]]:
    """Return words, a sentence, and which values are better, of each metric; of several figures that of the first."""
    from pasdedeux.augmentation import quality  # late: half of the science, for commands that only look
    from pasdedeux.sampling import diagnostics

    declared: dict[str, tuple[str, str, str]] = {}
    for one in (*quality.FIGURES.values(), *diagnostics.FIGURES.values()):
        sentence = one.meaning[0].lower() + one.meaning[1:]
        declared.setdefault(_without_ending(one.metric)[0], (one.words, sentence, one.better))
    known = {name: (*words, better) for better, metrics in _METRICS.items() for name, words in metrics.items()}
    return declared | known


def _known(base: str) -> tuple[str, str] | None:
    if base in _metrics():
        words, sentence, better = _metrics()[base]
        return words, f"{sentence}; {better} is better" if better else sentence
    return _METHODS.get(base)


def _parts(name: str) -> list[str]:
    """Return a name without its endings, then the endings in words; a name that is not known keeps its endings."""
    base, words = _without_ending(name)
    if _known(name) or not words:
        return [name]
    first, *more = _parts(base)
    return [first, *more, words] if _known(first) else [name]


def _without_ending(name: str) -> tuple[str, str]:
    """Return a name without its last ending, and that ending in words; empty where it has none."""
    ending = next((one for one in _ENDINGS if name.endswith(f"_{one}")), "")
    return (name.removesuffix(f"_{ending}"), _ENDINGS[ending]) if ending else (name, "")
