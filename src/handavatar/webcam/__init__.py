"""A hand before a camera, followed live: where it is, its pose, what has been seen of its skin."""
