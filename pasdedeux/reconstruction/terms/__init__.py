"""Terms of the scene estimate: one file a term, each with its residual and Jacobian."""
