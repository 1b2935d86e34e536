"""Avatars taken away: a rigged and textured GLB for engines, a posed surface as PLY or OBJ."""
