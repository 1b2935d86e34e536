"""A hand laid onto pictures: what was observed, one energy, one solver."""
