"""What a robot asks of a map: probabilities, ranges, collisions, where to look next."""
