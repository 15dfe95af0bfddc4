"""What the names of methods and metrics mean, in words for readers who do not know the code."""

from __future__ import annotations

import re
from collections.abc import Iterable
from functools import cache

_METHODS = {
    "interaction_mesh": ("interaction mesh", "bends the motion so that both people keep their place to each other"),
    "naive_fk": ("plain forward kinematics", "the source's joint angles on the new bones: the baseline"),
    "copy": ("copy of the source", "answers with the source, as if nobody had another size"),
    "ridge_scale": ("ridge regression on scales", "linear in the bone scales, fitted for each take"),
    "ridge_adapted": ("adapted ridge regression", "the same, fitted to a few near sizes of the very take asked for"),
    "solver": ("the solver", "the converged variant itself, which models are asked for: a bound"),
    "with_augmentation": ("with augmentation", "learned from takes and their variants"),
    "without_augmentation": ("without augmentation", "learned from the same takes alone"),
    "last_pose_held": ("last pose held", "nobody moves any more: the baseline"),
    "largest_class": ("largest class", "always the same answer: the baseline"),
    "mesh_refine": ("predicted, then refined", "another model's answer, from which the interaction mesh goes on"),
    "paper_cvae": ("the published network", "a conditional variational autoencoder as in Li et al. 2024"),
    "actor_like": ("ACTOR, adapted", "a transformer that knows scales as classes, as Li et al. 2024 adapted it"),
    "action2motion_like": ("Action2motion, adapted", "a recurrent network that knows scales as classes, likewise"),
    "nearest": ("nearest pose", "each frame alone: the pose of the database whose image is nearest"),
    "viterbi": ("best path", "the candidates of all frames that follow each other best"),
    "window": ("window rule", "the published rule: the candidate that fits a window of frames"),
    "fit": ("fit to the image", "the best path, then bent until its image is the given one"),
    "live": ("live", "frame by frame as a video comes, six frames behind"),
    "best_of_50": ("best of 50", "the best of the 50 nearest candidates, which nobody can know: a bound"),
    "standing_still": ("standing still", "the mean true pose in every frame: says how much people move"),
    "equal_depth": ("equal depth", "both people equally far from the camera"),
    "truth": ("the truth", "the captured motion itself"),
    "heaviest_hypothesis": ("likeliest view", "the view with the greatest weight"),
    "best_hypothesis": ("best of all views", "the view nearest to the true one, which nobody can know: a bound"),
    "mean_view": ("mean view", "the same view for every image: the baseline"),
    "ic": ("interaction coordinates", "chains that keep distances between both people's joints near the annotations'"),
    "prior_only": ("prior alone", "chains that know how joints turn, and no annotation: the baseline"),
    "grown_seeds": ("grown pairs", "annotations lifted from the seeds nearest to them, step by step"),
    "real_frames": ("real frames", "as many captured pairs as there are draws: how good draws could be"),
    "nearest_annotation": ("nearest annotation", "the image among those used that is most alike: no 3D at all"),
    "fitted": ("fitted draws", "mean of the nearest draws, bent to what is seen"),
    "blended": ("blended draws", "the nearest draws, laid onto what is seen"),
    "ic_and_grown_seeds": ("interaction coordinates and grown pairs", "the draws of both"),
    "prior_only_and_grown_seeds": ("prior alone and grown pairs", "the draws of both"),
    "blended_10": ("ten blended draws", "the same of the ten nearest draws alone"),
    "median": ("median of draws", "joint by joint the median of the nearest draws"),
    "neighbours": ("mean of draws", "the mean of the nearest draws"),
    "nearest_draw": ("nearest draw", "the one draw nearest to what is seen"),
    "mean_pair": ("mean pair", "the mean of all draws, whatever is seen: the baseline"),
    "naive_sampling": ("naive sampling", "poses drawn without chains"),
    "lifting": ("lifting alone", "the published lift of one image without draws"),
    "lifting_ik": ("lifting with limits", "the same, and joints kept within their limits"),
    "draws": ("along draws", "a path of draws between both ends"),
    "straight": ("straight line", "joints go straight from one end to the other: the baseline"),
    "detector": ("as a detector sees it", "joints missing, junk, people in any order"),
    "noise_alone": ("noise alone", "the same video with the same noise and nothing missing"),
}
"""Words and a sentence of each method."""
_METRICS = {
    "as_good_as_real_frames_D_C": (
        "as good as real frames, joint by joint",
        "as near as so many real frames",
        "larger",
    ),
    "as_good_as_real_frames_D_I": (
        "as good as real frames, by interaction",
        "as near as so many real frames",
        "larger",
    ),
    "as_good_as_real_frames_D_S": ("as good as real frames, by shape", "as near as so many real frames", "larger"),
    "lifted_D_C": ("distance of lifted pairs", "Cartesian distance from the true pair", "smaller"),
    "in_between_lifted_error": ("error between lifted pairs", "joint error of frames between lifted ones", "smaller"),
    "person_distance_error": ("error of the distance", "how far the distance of the two people is off", "smaller"),
    "relative_depth_error": ("error of the depth", "how far the depth between the two people is off", "smaller"),
    "log_prior": ("log prior", "how likely the poses are for bodies, images aside", ""),
    "hand_contact_drift": ("drift of hands and feet in contact", "the same for hands and feet", "smaller"),
    "body_contact_drift": ("drift of bodies in contact", "the same for everything else", "smaller"),
    "estimated_gap": ("estimated gap", "how far the solver thinks it is from the best answer", "smaller"),
    "sample_gap": ("measured gap", "how far it is from the best answer, on a sample", "smaller"),
    "error_root_kept": ("joint error", "mean distance of joints from the truth about the mid-hip", "smaller"),
    "error_root_removed": ("joint error, turned", "the same after the root's rotation was taken away", "smaller"),
    "error_scale_free": (
        "joint error, scaled",
        "the same after one scale, which a single camera does not see",
        "smaller",
    ),
    "jitter": ("jitter", "mean second difference from frame to frame", "smaller"),
    "pair_distance_error": ("error of the distance", "how far the distance of the two people is off", "smaller"),
    "pair_depth_error": ("error of the depth", "how far the depth between the two people is off", "smaller"),
    "pair_place_error": ("error of the place", "how far the place of the two people to each other is off", "smaller"),
    "left_out_d_I": ("left-out images", "distance of an image that was not used to the nearest draw", "smaller"),
    "coverage_D_C": ("coverage", "mean distance from a real pair to the nearest draw", "smaller"),
    "coverage_D_I": ("coverage by interaction", "the same by interaction coordinates", "smaller"),
    "coverage_D_S": ("coverage by shape", "the same by shape contexts", "smaller"),
    "draw_to_nearest_real_D_C": ("realism of draws", "distance from a draw to the nearest real pair", "smaller"),
    "lifted_pair_error": (
        "error of lifted pairs",
        "joint error with distance and depth between people kept",
        "smaller",
    ),
    "expected_error": ("expected error of lifted pairs", "the same told without the truth", "smaller"),
    "expected_interval_share": ("errors inside 80 %", "share of true errors within what is expected of 80 %", ""),
    "expected_correlation": ("expected against true", "correlation of expected and true errors", "larger"),
    "lifted_person_error": ("error of lifted people", "joint error of each person about their own root", "smaller"),
    "occluded_joint_error": (
        "error of completed joints",
        "distance of joints that were hidden from where they are",
        "smaller",
    ),
    "in_between_error": ("error in between", "joint error of frames that were filled in", "smaller"),
    "view_error": (
        "error of the view",
        "angle between the estimated direction to the camera and the true one",
        "smaller",
    ),
    "E_r_of_best_baseline": (
        "share of the best baseline's E_r",
        "below 100 % is better than giving the source back, plain kinematics and the closed form",
        "smaller",
    ),
    "contact_error": (
        "contact error",
        "how far contacts come from the distance that they had in the source",
        "smaller",
    ),
    "energy_gap": ("energy gap", "the mesh's energy over that of the solver's answer", "smaller"),
    "foot_slide": ("slide of feet", "how far the worst standing foot slides", "smaller"),
    "KID": ("KID", "distance of distributions without bias, times 1000; that of the solver is chance", "smaller"),
    "FID": ("FID", "the same for normal distributions, which grows with few clips", "smaller"),
    "density": ("density", "how many real neighbourhoods a clip lies in; about 1 for real ones", ""),
    "coverage": ("coverage of real clips", "share of real neighbourhoods with a clip inside", "larger"),
    "recognised": ("recognised", "share of clips whose interaction a classifier of real clips finds", "larger"),
    "accuracy": ("accuracy", "share of clips whose interaction is found", "larger"),
    "JME": ("JME", "error of predicted joints where the pair is", "smaller"),
    "AME": ("AME", "error of predicted poses laid onto the true ones", "smaller"),
    "E_r": ("joint error E_r", "mean joint distance from the true variant", "smaller"),
    "E_b": ("bone error E_b", "how far predicted bones are from their length", "smaller"),
    "JPD": (
        "JPD",
        "difference of the distances of key pairs; the solver pins those, so what is like it is favoured",
        "smaller",
    ),
    "PWD": ("PWD", "the same of all joints of one to all of the other, near ones weighing more (1 / d^2)", "smaller"),
    "identity_switches_per_minute": (
        "identity switches a minute",
        "how often somebody becomes somebody else",
        "smaller",
    ),
}
"""Words, a sentence, and which values are better, of each metric that is not declared as a figure."""
_ENDINGS = {"mean": "mean", "median": "median", "p90": "90 %", "p95": "95 %", "worst": "worst"}
_ENDINGS |= {"min": "least", "max": "most"}


def in_words(name: str) -> str:
    """Return a method's or metric's name as people say it; of unknown ones the words of the name.

    >>> in_words("hand_contact_drift_p95"), in_words("fit_clean"), in_words("new_score")
    ('drift of hands and feet in contact, 95 %', 'fit to the image, cleaned up', 'new score')
    """
    base, *endings = _parts(name)
    words = known[0] if (known := _known(base)) else re.sub(r"(?<=[a-z0-9])_(?=[a-z0-9])", " ", base)
    return ", ".join([words, *endings])


def meanings(names: Iterable[str]) -> tuple[tuple[str, str, str], ...]:
    """Return name, words and a sentence for each of these names that is known, sorted."""
    bases = sorted({_parts(name)[0] for name in names})
    return tuple((base, *found) for base in bases if (found := _known(base)) is not None)


def is_bound(method: str) -> bool:
    """Tell whether a method knows what nobody knows, so that it is no answer but a bound for answers."""
    return method in {"truth", "solver", "real_frames", "standing_still", "best_hypothesis", "best_of_50"}


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
    return declared | _METRICS


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
    base, _, ending = name.rpartition("_")
    words = {**_ENDINGS, "clean": "cleaned up"}.get(ending, "")
    return (base, words) if words else (name, "")
