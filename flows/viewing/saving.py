"""The folder of the panel with a link to the moment, and buttons that save pictures and clips."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self
from urllib.parse import quote

import cv2

from flows.viewing.panel import Panel, set_value
from flows.viewing.playing import STILLS_HZ
from pasdedeux.arrays import Array
from pasdedeux.errors import InputError

if TYPE_CHECKING:
    from flows.viewing.viewer import Viewer

_CLIP_S = 4.0
_CLIP_HZ = 10.0
_LIMIT_S = 60.0


@dataclass(frozen=True)
class LinkPane:
    """The link to the moment."""

    link: Any

    @classmethod
    def build(cls, panel: Panel, viewer: Viewer) -> Self:
        """Add the widgets to the panel; saving runs in the background."""
        with panel.gui.add_folder("Link and save", expand_by_default=False):
            pane = cls(panel.gui.add_text("moment", "", hint="Copy this link, or paste another one"))
            for label, save in (("Save picture", save_picture), ("Save clip", save_clip)):
                panel.button(label, lambda event, save=save: save(viewer, event.client), is_alone=False)
        panel.on_change(pane.link, viewer.visit)
        return pane

    def show(self, viewer: Viewer) -> None:
        """Show the link to the moment."""
        set_value(self.link, f"{viewer.url}?at={quote(viewer.moment.reference, safe='@')}")


def save_picture(viewer: Viewer, client: Any) -> None:
    """Send a browser its view as a PNG."""
    image = client.get_render(client.camera.image_height, client.camera.image_width, timeout=_LIMIT_S)
    client.send_file_download(f"{_name(viewer)}.png", encode_image(image, ".png"), save_immediately=True)


def save_clip(viewer: Viewer, client: Any) -> None:
    """Send a browser its view of the next seconds as an animated WebP.

    Raises:
        InputError: Another item was shown meanwhile.
    """
    with viewer.lock:
        viewer.play(False)
        name, scene, last = f"{_name(viewer)}.webp", viewer.scene, viewer.frame
        rate_hz = scene.rate_hz or STILLS_HZ
        step = max(1, round(rate_hz / _CLIP_HZ))
        frames = range(last, min(last + int(_CLIP_S * rate_hz), scene.num_frames), step)
    images = []
    for frame in frames:
        with viewer.lock:
            if viewer.scene is not scene or viewer.frame != last:
                raise InputError("the clip was not saved, because another item was shown meanwhile")
            viewer.seek(frame)
            last = frame
        images.append(
            client.get_render(client.camera.image_height // 2, client.camera.image_width // 2, timeout=_LIMIT_S)
        )
        viewer.panel.tell(f"saving a clip: {frame - frames.start} of {len(frames) * step} frames")
    client.send_file_download(name, encode_clip(images, rate_hz / step), save_immediately=True)
    viewer.panel.tell(f"saved {name}")


def _name(viewer: Viewer) -> str:
    return f"{viewer.part.table}-{'-'.join(viewer.item.names)}-{viewer.frame}".replace("/", "-")


def encode_image(image: Array, suffix: str) -> bytes:
    """Encode an image (height, width, 3 or 4), RGB, as a file of this kind."""
    return cv2.imencode(suffix, cv2.cvtColor(image[..., :3], cv2.COLOR_RGB2BGR))[1].tobytes()


def encode_clip(images: Sequence[Array], rate_hz: float) -> bytes:
    """Encode images (height, width, 3), RGB, as an animated WebP that repeats."""
    animation = cv2.Animation()
    animation.frames = [cv2.cvtColor(image[..., :3], cv2.COLOR_RGB2BGRA) for image in images]
    animation.durations = [round(1000.0 / rate_hz)] * len(images)
    animation.loop_count = 0
    return cv2.imencodeanimation(".webp", animation, [cv2.IMWRITE_WEBP_QUALITY, 80])[1].tobytes()
