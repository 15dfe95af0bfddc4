"""Topics that only the studies of the papers ask for."""
