"""People in film: shots, tracking of joints between key frames, filling gaps, corrections, detectors, drawings."""
