"""What a page asks to see, as a value; and the only way from what it sends to that value.

Nothing that comes from a page is trusted: :func:`read_scene` refuses whatever is not exactly of
this form, and every number has a range.
"""

import json
import math
from dataclasses import dataclass
from typing import Any

from handavatar.capture.frames import MAX_CLIPS
from handavatar.edit import bones_named
from handavatar.errors import HandAvatarError
from handavatar.hand.pose import FINGER_BONES, NUM_BONES

LAYERS = ("rgb", "albedo", "illumination", "normal", "mesh")
UNSEEN = "unseen"
"""A layer of finished avatars: the picture with a tint on skin that no training frame saw."""
SIZES = (64, 128, 192, 256, 384, 512)
MOST_STROKES = 400
MOST_STEPS = 100_000
MOST_ANCHORS = 1_000_000
_NAME_LENGTH = 40


class SceneError(HandAvatarError):
    """A page sent what is no scene: what was found and what was expected."""


@dataclass(frozen=True)
class Moment:
    """One step of a motion that the viewer knows.

    Attributes:
        motion: its name.
        step: from 0.
    """

    motion: str
    step: int


@dataclass(frozen=True)
class Orbit:
    """Where the camera stands, from where it stood in the capture. The default is there.

    As a person sees it: of a left hand's picture, too, to the right is to the right.

    Attributes:
        azimuth: around the hand, about the picture's vertical; radians.
        elevation: over the hand; radians.
        zoom: of the picture about its middle.
        shift: of the picture to the right and down, in widths of the picture.
    """

    azimuth: float = 0.0
    elevation: float = 0.0
    zoom: float = 1.0
    shift: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Stroke:
    """A dab of paint on the skin.

    Attributes:
        anchor: in the middle of it.
        radius: metres; it fades out towards there.
        color: RGB in [0, 1].
    """

    anchor: int
    radius: float
    color: tuple[float, float, float]


@dataclass(frozen=True)
class Coat:
    """A picture laid on all the skin, as ``--paint`` lays it.

    Attributes:
        picture: by the name that the viewer gave it when it was sent.
    """

    picture: str


@dataclass(frozen=True)
class Touches:
    """The edits of a page, whole: they take the place of the avatar's own.

    Attributes:
        light_gain: multiplies the illumination.
        albedo_shift: added to the albedo, RGB in [-1, 1].
        lifted_bones: bones that cast no shadow.
        strokes: dabs and pictures, over what paint the avatar has, later ones on top.
        light: of an avatar of several clips, the number of the one in whose light it is shown.
    """

    light_gain: float = 1.0
    albedo_shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    lifted_bones: tuple[int, ...] = ()
    strokes: tuple[Stroke | Coat, ...] = ()
    light: int = 0


@dataclass(frozen=True)
class Scene:
    """What is to be seen.

    Attributes:
        moment: gives the hand's place and, without ``angles``, its fingers; None is the capture's
            typical view.
        angles: flexion, abduction and twist of every bone, radians, the wrist's without meaning;
            None leaves the fingers of the moment.
        turn: of the hand about the middle of its palm, axis-angle in its own axes, radians.
        orbit: the camera.
        layer: one of ``LAYERS``, or ``UNSEEN``.
        size: of the finished picture, pixels along a side; one of ``SIZES``.
        touches: the edits.
    """

    moment: Moment | None = None
    angles: tuple[tuple[float, float, float], ...] | None = None
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0)
    orbit: Orbit = Orbit()
    layer: str = "rgb"
    size: int = 256
    touches: Touches = Touches()


@dataclass(frozen=True)
class View:
    """What is to be seen of a training.

    Attributes:
        frame: number among the training frames.
        layer: one of ``LAYERS``.
        size: pixels along a side.
    """

    frame: int
    layer: str
    size: int


def read_json(body: bytes) -> dict[str, Any]:
    """One JSON object without NaN, however deep or wrong what came was.

    Raises:
        SceneError: if it is none.
    """
    try:
        content = json.loads(body.decode("utf-8"), parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as error:
        raise SceneError(f"not JSON: {str(error)[:80]}") from error
    if not isinstance(content, dict):
        raise SceneError(f"expected a JSON object, found {_short(content)}")
    return content


def read_scene(content: Any) -> Scene:
    """The scene that a page's JSON describes; what it leaves out is as by default.

    Angles come in degrees, the radius of paint in millimetres, lifted shadows as names.

    Raises:
        SceneError: what is wrong with it.
    """
    given = fields(
        content, "scene", ("moment", "angles", "turn", "orbit", "layer", "size", "touches")
    )
    angles = given.get("angles")
    if angles is not None:
        rows = _list(angles, "angles", NUM_BONES)
        angles = tuple(_degrees(row, "angles") for row in rows)
        if len(angles) != NUM_BONES:
            raise SceneError(f"angles: expected {NUM_BONES} rows, found {len(angles)}")
    moment = given.get("moment")
    return Scene(
        None if moment is None else read_moment(moment),
        angles,
        _degrees(given.get("turn", [0, 0, 0]), "turn"),
        _orbit(given.get("orbit", {})),
        _word(given.get("layer", "rgb"), "layer", (*LAYERS, UNSEEN)),
        _size(given.get("size", 256)),
        read_touches(given.get("touches", {})),
    )


def read_view(content: Any) -> View:
    """What a page wants to see of a training; what it leaves out is as by default.

    Raises:
        SceneError: what is wrong with it.
    """
    given = fields(content, "view", ("frame", "layer", "size"))
    return View(
        whole(given.get("frame", 0), "frame", 0, MOST_STEPS),
        _word(given.get("layer", "rgb"), "layer", LAYERS),
        _size(given.get("size", 256)),
    )


def read_moment(content: Any) -> Moment:
    """A step of a motion, by name.

    Raises:
        SceneError: what is wrong with it.
    """
    given = fields(content, "moment", ("motion", "step"))
    name = given.get("motion")
    if not isinstance(name, str) or not 0 < len(name) <= _NAME_LENGTH:
        raise SceneError(f"motion: expected a name, found {_short(name)}")
    return Moment(name, whole(given.get("step", 0), "step", 0, MOST_STEPS))


def read_touches(content: Any) -> Touches:
    """The edits of a page.

    Raises:
        SceneError: what is wrong with them.
    """
    known = ("light_gain", "albedo_shift", "lift_shadow", "strokes", "light")
    given = fields(content, "touches", known)
    names = _list(given.get("lift_shadow", []), "lift_shadow", NUM_BONES)
    if not all(isinstance(name, str) for name in names):
        raise SceneError("lift_shadow: expected names of fingers or bones")
    try:
        bones = bones_named(tuple(names))
    except ValueError as error:
        raise SceneError(f"lift_shadow: choose among {', '.join(FINGER_BONES)}") from error
    strokes = _list(given.get("strokes", []), "strokes", MOST_STROKES)
    return Touches(
        number(given.get("light_gain", 1.0), "light_gain", 0.0, 10.0),
        _triple(given.get("albedo_shift", [0, 0, 0]), "albedo_shift", -1.0, 1.0),
        bones,
        tuple(_stroke(stroke) for stroke in strokes),
        whole(given.get("light", 0), "light", 0, MAX_CLIPS - 1),
    )


def fields(value: Any, name: str, known: tuple[str, ...]) -> dict[str, Any]:
    """An object with no names but the known ones.

    Raises:
        SceneError: if it is none.
    """
    if not isinstance(value, dict):
        raise SceneError(f"{name}: expected an object, found {_short(value)}")
    if unknown := set(value) - set(known):
        raise SceneError(f"{name}: there is no {_short(sorted(unknown)[0])}")
    return value


def number(value: Any, name: str, least: float, greatest: float) -> float:
    """A finite number within a range.

    Raises:
        SceneError: if it is none.
    """
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if not is_number or not least <= value <= greatest:  # NaN compares as false
        raise SceneError(f"{name}: expected {least:g} to {greatest:g}, found {_short(value)}")
    return float(value)


def whole(value: Any, name: str, least: int, greatest: int) -> int:
    """A whole number within a range.

    Raises:
        SceneError: if it is none.
    """
    if not isinstance(value, int) or isinstance(value, bool) or not least <= value <= greatest:
        raise SceneError(
            f"{name}: expected a whole number from {least} to {greatest}, found {_short(value)}"
        )
    return value


def _size(value: Any) -> int:
    size = whole(value, "size", SIZES[0], SIZES[-1])
    if size not in SIZES:
        raise SceneError(f"size: expected one of {SIZES}, found {size}")
    return size


def _orbit(content: Any) -> Orbit:
    given = fields(content, "orbit", ("azimuth", "elevation", "zoom", "shift"))
    shift = _list(given.get("shift", [0, 0]), "shift", 2)
    if len(shift) != 2:
        raise SceneError(f"shift: expected two numbers, found {len(shift)}")
    return Orbit(
        math.radians(number(given.get("azimuth", 0), "azimuth", -3600.0, 3600.0)),
        math.radians(number(given.get("elevation", 0), "elevation", -90.0, 90.0)),
        number(given.get("zoom", 1), "zoom", 0.25, 8.0),
        (number(shift[0], "shift", -4.0, 4.0), number(shift[1], "shift", -4.0, 4.0)),
    )


def _stroke(content: Any) -> Stroke | Coat:
    if isinstance(content, dict) and "picture" in content:
        name = fields(content, "stroke", ("picture",))["picture"]
        if not isinstance(name, str) or not 0 < len(name) <= _NAME_LENGTH:
            raise SceneError(f"picture: expected a name, found {_short(name)}")
        return Coat(name)
    given = fields(content, "stroke", ("anchor", "radius", "color"))
    return Stroke(
        whole(given.get("anchor"), "anchor", 0, MOST_ANCHORS),
        number(given.get("radius"), "radius", 1.0, 30.0) / 1000,
        _triple(given.get("color"), "color", 0.0, 1.0),
    )


def _degrees(value: Any, name: str) -> tuple[float, float, float]:
    first, second, third = _triple(value, name, -180.0, 180.0)
    return math.radians(first), math.radians(second), math.radians(third)


def _triple(value: Any, name: str, least: float, greatest: float) -> tuple[float, float, float]:
    items = _list(value, name, 3)
    if len(items) != 3:
        raise SceneError(f"{name}: expected three numbers, found {len(items)}")
    first, second, third = (number(item, name, least, greatest) for item in items)
    return first, second, third


def _list(value: Any, name: str, most: int) -> list[Any]:
    if not isinstance(value, list) or len(value) > most:
        raise SceneError(f"{name}: expected a list of at most {most}, found {_short(value)}")
    return value


def _word(value: Any, name: str, known: tuple[str, ...]) -> str:
    if not isinstance(value, str) or value not in known:
        raise SceneError(f"{name}: expected one of {', '.join(known)}, found {_short(value)}")
    return value


def _refuse_constant(name: str) -> float:
    raise ValueError(f"{name} is no number")


def _short(value: Any) -> str:
    """What was found, cut off, without what a terminal would obey."""
    if isinstance(value, list | dict):
        return f"{type(value).__name__} of {len(value)}"
    return ascii(value)[:40]
