"""Why a picture of a video is not in the capture, in words for people."""

from dataclasses import dataclass

from handavatar.capture.tracking import NO_HAND, OTHER_HAND, TWO_HANDS

NO_MASK, NO_CAMERA = "no mask", "no camera"


@dataclass(frozen=True)
class LeftOut:
    """Why a picture is not in the capture.

    Attributes:
        kind: a key of ``CAUSES``.
        text: the same with figures.
    """

    kind: str
    text: str


CAUSES: dict[str, tuple[str, str]] = {
    "border": (
        "the hand leaves the picture",
        "keep the whole hand and the wrist in the picture: step back, or move to its middle",
    ),
    "hidden": (
        "something hides the hand",
        "push the sleeve back, and let nothing come before the hand",
    ),
    "background": (
        "what is behind the hand looks like skin (a face, clothes, wood)",
        "hold the hand before something of another colour",
    ),
    "pose": (
        "hand and tracked pose do not fit together",
        "move slowly; turn fists and edge-on hands so that the fingers are seen",
    ),
    "side": (
        "the hand may have been taken for the other one",
        "if the side is wrong, name it with `side='left'` or `side='right'`",
    ),
    "small": ("the hand is too small", "come closer to the camera"),
    "dark": ("the pictures are too dark", "record in more light"),
    NO_MASK: ("it has no mask", "give a mask for every picture (`masks`)"),
    NO_CAMERA: ("its camera is not known", "give the camera of every picture (`camera`)"),
    TWO_HANDS: (
        "there are two hands",
        "choose one with `hand='left'`, `hand='right'` or `hand='larger'`, or record one alone",
    ),
    OTHER_HAND: (
        "it is the other hand",
        "record one hand, or choose it with `side='left'` or `side='right'`",
    ),
    NO_HAND: ("no hand is seen", "record one bare hand, whole, larger than a sixth of the picture"),
}
"""What goes wrong with a picture, and what to do about it."""
