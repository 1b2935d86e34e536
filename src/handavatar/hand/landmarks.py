"""The 21 landmarks by which trackers tell a hand: wrist, then each finger's joints and its tip."""

from handavatar.hand.pose import FINGER_BONES, NUM_BONES

NUM_LANDMARKS = 21
MIDDLE_KNUCKLE = 9
"""The landmark whose distance from the wrist, landmark 0, is a hand's size."""
KNUCKLES = (5, 9, 13, 17)
"""Landmarks where the four long fingers begin; with the wrist they hardly move in a hand."""
HAND_SIZE = 0.093
"""Metres from the wrist's joint to the middle finger's knuckle of a usual hand: the unit of tracked
depths."""
_FINGERS = ("thumb", "index", "middle", "ring", "little")

LANDMARK_BONES: tuple[int, ...] = (
    0,
    *(bone for finger in _FINGERS for bone in (*FINGER_BONES[finger], FINGER_BONES[finger][-1])),
)
"""The bone that carries each landmark."""
LANDMARK_ROWS: tuple[int, ...] = (
    0,
    *(
        row
        for number, finger in enumerate(_FINGERS)
        for row in (*FINGER_BONES[finger], NUM_BONES + number)
    ),
)
"""Where each landmark stands among the joints, bone by bone, and then the fingertips."""
