"""Images of a map, and an interactive viewer."""
