"""Learning: models that give a pair's motion for new body proportions, and the splits they are judged on."""
