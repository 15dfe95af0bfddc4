"""Several cameras of one take: their clocks, their places, and poses fitted to all of their images."""
