"""Learned functions of a point near the hand: occupancy, albedo, illumination, shape."""
