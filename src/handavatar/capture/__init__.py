"""Frames of a hand with a known pose: read, written, made from a video or rendered."""
