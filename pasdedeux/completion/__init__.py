"""What draws are good for: lifting annotations by retrieval, completing occluded joints, in-betweens, and baselines."""
