"""Sources of 2D poses that are a folder with a file for each image."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence

from pasdedeux.errors import FormatError
from pasdedeux.formats.annotated_frames import AnnotatedFrames
from pasdedeux.formats.detections import Detection, Place, join_detections, places_of_names
from pasdedeux.formats.file_format import AnnotationFormat


class FrameFiles(AnnotationFormat):
    """A folder of files, one for each image, whose names tell their frames; they state no image size and no rate."""

    suffixes = (".json",)
    is_file_per_frame = True

    @abstractmethod
    def detections(self, data: bytes | str, place: Place, name: str) -> list[Detection]:
        """Return the people of one image's file; those without any keypoint are left out.

        Args:
            data: The file.
            place: Video and frame that its name tells.
            name: Its name, for messages; may be empty.

        Raises:
            FormatError: The file is mangled.
        """

    def frame_numbers(self, names: Sequence[str]) -> list[int]:
        """Return the frame that each file of a camera is of, by its name."""
        places = places_of_names(names)
        return [places[name][1] for name in names]

    def read(
        self, files: Mapping[str, bytes], *, sequence_id: str, layout: str = "auto", skip_unreadable: bool = False
    ) -> AnnotatedFrames:
        """Read the files of all frames; the one that is damaged is named.

        The last file may be cut off, because its writer was stopped: it is left out like one that may be skipped.
        """
        found: list[Detection] = []
        skipped: list[str] = []
        numbers = self.frame_numbers(list(files))
        for number, (name, data) in zip(numbers, files.items(), strict=True):
            try:
                found += self.detections(data, ("", number), name)
            except FormatError as error:
                if not skip_unreadable and (number < max(numbers) or len(files) == 1):
                    raise FormatError(f'{name}: {error} (set on_unreadable = "skip" to go on without it)') from None
                skipped.append(name)
        return join_detections(found, sequence_id=sequence_id, layout=layout, skipped=skipped)
