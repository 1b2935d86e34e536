"""Prior art, small and honest, on the same frames and the same fitted hand as ours.

Only for comparison: nothing here is part of an avatar.
"""
