"""Virtual video: annotations of takes by virtual cameras."""
