"""HandAvatar: a personal, posable, editable avatar of a hand from an ordinary video."""

__version__ = "0.1.0"
