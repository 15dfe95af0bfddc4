"""What only the studies of the three papers use: ways to explore, and views of motion that no database has."""
