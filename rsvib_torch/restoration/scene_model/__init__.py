"""Statistical model of the scene and of how the rows of the frames observe it."""
