"""Meshes of what is occupied."""
