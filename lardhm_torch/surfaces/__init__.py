"""Surface meshes of occupied space."""
