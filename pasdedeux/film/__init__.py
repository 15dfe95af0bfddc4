"""People in film: shots, tracking of joints between key frames, filling, what to correct next, detectors, overlays."""
