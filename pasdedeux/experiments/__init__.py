"""What only the studies of the three papers use: published methods to compare with, and ways to judge them."""
