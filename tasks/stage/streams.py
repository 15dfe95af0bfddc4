"""Random streams by meaning."""

from __future__ import annotations

import hashlib

import numpy as np


def stream(seed: int, *labels: str | int) -> np.random.Generator:
    """Return the random generator of (seed, labels...): the labels name its purpose, never its worker.

    Text labels enter by their sha256, so streams of different labels are independent.
    """
    words = [seed]
    for label in labels:
        if isinstance(label, int):
            words.append(label)
        else:
            digest = hashlib.sha256(label.encode()).digest()
            words.extend(int.from_bytes(digest[i : i + 4], "little") for i in range(0, 16, 4))
    return np.random.default_rng(np.random.SeedSequence(words))
