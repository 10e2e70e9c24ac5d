"""Pictures and pages of a map."""
