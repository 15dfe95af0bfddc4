"""Learning: models that predict a pair's motion for new body proportions, and the splits for their evaluation."""
