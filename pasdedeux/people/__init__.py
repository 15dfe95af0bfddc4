"""People in 2D detections, resolved once for all later stages: identities, repair of detector faults, and pairs."""
