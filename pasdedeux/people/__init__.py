"""Who is who in 2D detections, once for everything that follows: identities, faults of detectors, and pairs."""
