"""The facts of artifacts: what each kind states besides its tables, for planning and for people.

Fields that were not set are not written: a manifest holds exactly the facts that its stage gave.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Literal, Self

from pydantic import ConfigDict, Field, ValidationError

from pasdedeux.augmentation import UserContact
from pasdedeux.errors import InputError
from pasdedeux.settings import Settings, first_problem
from pasdedeux.skeletons import BODY22
from storage_schema import ArtifactRef, Manifest, Store

Purpose = Literal["video", "random_views", "given"]


class Facts(Settings):
    """Facts that every artifact may have: the takes that it shows or was made from, and skipped inputs."""

    model_config = ConfigDict(validate_by_name=True, validate_by_alias=True, serialize_by_alias=True)

    kind: str = ""
    takes: tuple[str, ...] = ()
    skipped: tuple[str, ...] = ()

    @classmethod
    def of(cls, manifest: Manifest) -> Self:
        """Return the facts of an artifact; unknown ones are ignored.

        Raises:
            InputError: A fact is missing or has another form: an earlier version wrote it.
        """
        try:
            return cls.model_validate(manifest.facts, extra="ignore")
        except ValidationError as error:
            raise InputError(
                f"artifact {manifest.ref.stage}@{manifest.ref.key[:12]} was written by another version: its fact "
                f"{first_problem(error)}; run its study again"
            ) from None

    @classmethod
    def read(cls, store: Store, refs: Iterable[ArtifactRef]) -> list[Self]:
        """Return the facts of several artifacts."""
        return [cls.of(store.manifest(ref)) for ref in refs]

    def to_json(self) -> dict[str, Any]:
        """Return the stated facts as JSON values."""
        kind = {"kind": self.kind} if self.kind else {}
        return kind | self.model_dump(mode="json", exclude_unset=True)


class PeopleFacts(Facts):
    """People in motion: how many, in how many frames."""

    num_persons: int = 0
    num_frames: int = 0
    rate_hz: float = 0.0
    is_held_out: bool = False


class TakeFacts(PeopleFacts):
    """A take with its poses, or one that was rejected at ingest."""

    kind: Literal["take"] = "take"
    take_id: str
    is_prior: bool = False
    is_built_in: bool = False
    contacts: tuple[UserContact, ...] = ()


class VariantOrigin(Settings):
    """The trained model that variants were sampled from: its name, split, artifact and last segment, and the seed."""

    model: str
    split: str
    artifact: str
    segment: int
    seed: int


class VariantFacts(PeopleFacts):
    """A batch of variants of a take; `parameters` says how they were solved, for readers that solve more of them.

    Those of a model have an `origin`, those of the solver none.
    """

    kind: Literal["variants"] = "variants"
    take_id: str
    variants: tuple[str, ...] = ()
    closest_m: float | None = None
    parameters: dict[str, Any] = Field({}, alias="told")
    origin: VariantOrigin | None = None


class CoupleFact(Settings):
    """Two people of a sequence taken for partners, and the number of frames in which they are near each other."""

    sequence_id: str
    person_ids: tuple[int, int]
    num_near_frames: int


class DetectedSequence(Settings):
    """Identities of the people in a sequence of a detector; couples by the ids of both."""

    sequence_id: str
    num_people: int
    num_true_people: int
    num_identity_switches: int
    couples: tuple[tuple[int, int], ...]


class SequenceFacts(PeopleFacts):
    """Annotated sequences, and statements on their camera and people.

    `why_no_video` gives, by sequence, the reason why frames do not follow each other in time; `calibration` is the TOML
    of one and the table of this camera.
    """

    kind: Literal["sequences"] = "sequences"
    sequence_ids: tuple[str, ...] = ()
    is_virtual: bool = False
    is_built_in: bool = False
    purpose: Purpose | None = None
    format: str = ""
    layout: str = ""
    num_skipped_frames: int = 0
    skipped_files: tuple[str, ...] = ()
    couples: tuple[CoupleFact, ...] = ()
    why_no_video: dict[str, str] = Field({})
    camera_height_m: float | None = None
    statures_m: dict[int, float] = Field({})
    camera_of: str | None = None
    calibration: tuple[str, str] | None = None
    num_merged_rows: int = 0
    num_ghost_rows: int = 0
    num_repaired_joints: int = 0
    num_renamed_rows: int = 0
    detected: tuple[DetectedSequence, ...] = ()


class PriorFacts(Facts):
    """Torso basis and joint limits."""

    kind: Literal["priors"] = "priors"
    num_poses: int
    origin: str
    explained_variance: float
    valid_share: float | None


class ViewFacts(Facts):
    """Views of the annotations of an artifact."""

    kind: Literal["views"] = "views"
    learned_takes: tuple[str, ...]
    torso_basis: str
    sequence_ids: tuple[str, ...]
    purpose: Purpose | None
    is_held_out: bool
    num_annotations: int
    num_without_view: int
    num_hypotheses: int
    size_ratio: float


class SeedFacts(Facts):
    """One seed, or many lifted, grown or filled in; `starts` are the indices of those that chains start from."""

    kind: Literal["seed", "lifted_seeds", "grown_seeds", "filled_seeds"]
    seed_index: int = 0
    take_id: str = ""
    take_frame: int = 0
    made_from: str = ""
    starts: tuple[int, ...] = ()
    num_grown: int = 0
    num_refused: int = 0
    num_left: int = 0
    num_annotations_skipped: int = 0

    @property
    def start_indices(self) -> tuple[int, ...]:
        """The indices of the seeds from which chains start."""
        return (self.seed_index,) if self.kind == "seed" else self.starts


class ChainFacts(Facts):
    """The chains of one density and seed."""

    kind: Literal["draws", "chain_info"] = "chain_info"
    density: str
    seed_index: int = 0


class DrawFacts(ChainFacts):
    """A segment of a chain, or the ends of short chains from `num_starts` pairs, the first of which is the seed."""

    kind: Literal["draws"] = "draws"
    chain: int = 0
    segment: int = 0
    num_draws: int = 0
    num_starts: int = 0
    log_seed: float = 0.0
    log_ceiling: float | None = None
    sigma_l: float | None = None
    num_annotations_skipped: int = 0
    note: str = ""


class LiftedFacts(Facts):
    """Annotations of an artifact in 3D."""

    kind: Literal["lifted_pairs"] = "lifted_pairs"
    sequence_ids: tuple[str, ...]
    purpose: Purpose | None
    is_held_out: bool
    num_draws: int
    num_lifted: int
    learned_takes: tuple[str, ...]


class ProjectionFacts(Facts):
    """A part of a projection database; `pitches_deg` are those of the cameras that see it."""

    kind: Literal["projections"] = "projections"
    origin: str = ""
    num_poses: int = 0
    rate_hz: float
    pitches_deg: tuple[float, ...]


class MotionFacts(Facts):
    """The motions of a sequence; `camera_height_m` and `lens_factor` where the scene was estimated as a whole.

    `cameras` says of each camera, where several saw it, where it is and how well it agrees.
    """

    kind: Literal["motions"] = "motions"
    sequence_ids: tuple[str, ...] = ()
    sequence_takes: tuple[str, ...] = ()
    database_takes: tuple[str, ...] = ()
    methods: tuple[str, ...] = ()
    num_persons: int = 0
    camera_height_m: float | None = None
    lens_factor: float | None = None
    pitch_deg: float = 0.0
    pitch_deviation_deg: float = 0.0
    num_projections: int = 0
    cameras: tuple[str, ...] = ()


class ModelFacts(Facts):
    """A model after a segment of its training, on `device`; `train`, `validation` and `test` are variants by take."""

    kind: Literal["model", "model_state"] = "model"
    split: str
    model: str
    class_name: str = Field(alias="class")
    description: dict[str, Any] | None = None
    skeleton: str = BODY22.name
    device: str = "cpu"
    segment: int = 0
    shares_takes: bool
    train: dict[str, tuple[str, ...]]
    validation: dict[str, tuple[str, ...]]
    test: dict[str, tuple[str, ...]]


class SkippedFacts(Facts):
    """Results that were not made, and why."""

    kind: Literal["left_out", "nobody"] = "left_out"


class TopicFacts(Facts):
    """The sentences of a topic of the evaluation."""

    captions: dict[str, str] = Field({})
    notes: tuple[str, ...] = ()


_COUNTED: dict[str, type[Facts]] = {
    "take": TakeFacts,
    "sequences": SequenceFacts,
    "variants": VariantFacts,
    "lifted_seeds": SeedFacts,
    "grown_seeds": SeedFacts,
    "filled_seeds": SeedFacts,
    "draws": DrawFacts,
    "lifted_pairs": LiftedFacts,
    "model": ModelFacts,
}


def facts_of(manifest: Manifest) -> Facts:
    """Return the facts of an artifact in the class of its kind, if it is a kind that people count."""
    return _COUNTED.get(manifest.facts.get("kind", ""), Facts).of(manifest)


def merge_takes(*manifests: Manifest) -> tuple[str, ...]:
    """Return the takes that any of these artifacts learned from or shows, sorted."""
    return tuple(sorted({take for manifest in manifests for take in Facts.of(manifest).takes}))


def shares_takes(first: Manifest, other: Manifest) -> bool:
    """Tell whether two artifacts rest on a common take."""
    return not set(Facts.of(first).takes).isdisjoint(Facts.of(other).takes)
