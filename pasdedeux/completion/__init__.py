"""Applications of draws: lifting annotations by retrieval, completing occluded joints, in-betweens, and baselines."""
