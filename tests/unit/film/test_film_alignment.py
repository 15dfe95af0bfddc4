"""Align a film with its take: who is who, clocks and camera; refuse another motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pasdedeux.cameras.pinhole import PinholeCamera
from pasdedeux.cameras.virtual_video import look_at_camera
from pasdedeux.errors import InputError
from pasdedeux.reconstruction.film_alignment import MAX_RESIDUAL, align_film
from pasdedeux.reconstruction.tracks import Lens, Track
from tests.builders.walkers import walk

HZ, FILM_HZ, NOISE_PX = 60.0, 25.0, 5.0
PITCH_RAD = 0.25


def people(*seeds: int, num_frames: int = 500) -> np.ndarray:
    """Return walkers side by side (frame, person, 14, 3)."""
    return np.stack(
        [walk(num_frames, seed=seed, rate_hz=HZ) + np.array([1.4 * at, 0.0, 0.0]) for at, seed in enumerate(seeds)],
        axis=1,
    )


def camera() -> PinholeCamera:
    return look_at_camera(np.array([1.0, 0.9, 1.5]), distance_m=5.0, yaw_rad=0.7, pitch_rad=PITCH_RAD, focal_px=1200.0)


def film(truth: np.ndarray, *, offset_s: float, rate: float, is_lens_known: bool = False) -> list[Track]:
    """Return tracks of 4 s of these people, in reverse order, by another clock."""
    rng, count = np.random.default_rng(0), 100
    frames = (offset_s + rate * np.arange(count) / FILM_HZ) * HZ
    low, share = frames.astype(int), (frames % 1.0)[:, None, None, None]
    px = camera().project((1.0 - share) * truth[low] + share * truth[low + 1]).px
    px += rng.normal(0.0, NOISE_PX, px.shape)
    confidence = (rng.random(px.shape[:3]) > 0.1).astype(float)
    lens = replace(Lens.assumed(1920, 1080, px[:, 0]), is_known=is_lens_known)
    lens = replace(lens, focal_px=1200.0) if is_lens_known else lens
    number = truth.shape[1] - 1
    return [
        Track(px[:, number - person], confidence[:, number - person], FILM_HZ, lens, person_id=person)
        for person in range(number + 1)
    ]


@pytest.mark.parametrize(("rate", "is_lens_known"), [(1.004, False), (0.5, True)])
def test_people_clocks_and_camera_are_found_back(rate: float, is_lens_known: bool) -> None:
    truth = people(50, 51, 52)
    seen = film(truth, offset_s=2.237, rate=rate, is_lens_known=is_lens_known)  # the third of them is a passer-by
    found = align_film(seen, truth[:, :2], HZ)
    assert found.person_ids == (2, 1)
    assert found.offset_s == pytest.approx(2.237, abs=0.01)
    assert found.rate == pytest.approx(rate, rel=0.003)
    # The keypoints' noise is all that is left: its median distance over the height of people.
    assert 0.005 < found.residual < 0.025
    assert np.rad2deg(found.camera.pitch_rad - PITCH_RAD) == pytest.approx(0.0, abs=0.5)
    np.testing.assert_allclose(found.camera.position_m, camera().position_m, atol=0.15)
    np.testing.assert_allclose(found.camera.focal_px, 1200.0, rtol=1e-3 if is_lens_known else 0.03)
    times_s = np.array([0.0, 2.0, 60.0])
    at = found.truth_at(truth, HZ, times_s)
    np.testing.assert_allclose(at[1], truth[round((2.237 + 2.0 * rate) * HZ)], atol=0.03)
    assert np.isnan(at[2]).all()
    assert "person 2 is A, person 1 is B" in found.in_words()


def test_what_the_film_never_shows_of_people_does_not_make_them_taller() -> None:
    truth = people(50, 51)
    seen = film(truth, offset_s=1.0, rate=1.0)
    cut = [replace(track, confidence=np.where(np.arange(14) == 0, 0.0, track.confidence)) for track in seen]
    whole, headless = (align_film(tracks, truth, HZ).residual for tracks in (seen, cut))
    assert headless == pytest.approx(whole, rel=0.2)


def test_another_motion_and_too_few_people_are_refused() -> None:
    seen = film(people(50, 51), offset_s=1.0, rate=1.0)
    with pytest.raises(InputError, match=f"allowed {100 * MAX_RESIDUAL:.0f} %.*it is another motion"):
        align_film(seen, people(60, 61)[::-1], HZ)
    with pytest.raises(InputError, match="the film shows 1 person, the take has 2"):
        align_film(seen[:1], people(50, 51), HZ)
    unseen = [replace(track, confidence=np.zeros_like(track.confidence)) for track in seen]
    with pytest.raises(InputError, match="no clock brings enough joints"):
        align_film(unseen, people(50, 51), HZ)
