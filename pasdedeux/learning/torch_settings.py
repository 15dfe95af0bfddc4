"""Settings of models that torch trains; without torch, so that studies can be read where it is not installed."""

from __future__ import annotations

from importlib.util import find_spec

from pydantic import Field

from pasdedeux.errors import InputError
from pasdedeux.settings import Settings


class SegmentSettings(Settings):
    """How long a model is trained."""

    num_steps: int = Field(600, ge=1, description="Steps of training")
    segment_steps: int = Field(200, ge=1, description="Steps of a segment, the unit that is stored and resumed")

    @property
    def num_segments(self) -> int:
        """In how many segments it is trained."""
        return -(-self.num_steps // self.segment_steps)


class TorchSettings(SegmentSettings):
    """How long a model is trained, and how fast."""

    learning_rate: float = Field(0.05, gt=0, le=1, description="Learning rate of Adam at the start")


def has_torch() -> bool:
    """Tell whether torch is installed, without loading it."""
    return find_spec("torch") is not None


def require_torch(name: str) -> None:
    """Refuse to go on without torch.

    Raises:
        InputError: Names the model that needs it, and how it is installed.
    """
    if not has_torch():
        raise InputError(f"{name} needs torch, which is not installed: pip install 'pasdedeux[learning]'")
