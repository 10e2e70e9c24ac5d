"""How good a map is, and the methods that it is compared with."""
