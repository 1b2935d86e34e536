"""What pages send becomes a scene, or is refused."""

import json
import math
import random

import pytest

from handavatar.view.scene import (
    MOST_STROKES,
    Coat,
    Moment,
    Orbit,
    Scene,
    SceneError,
    Stroke,
    Touches,
    View,
    read_json,
    read_scene,
    read_view,
)

WHOLE = {
    "moment": {"motion": "count", "step": 3},
    "angles": [[90, 0, -45]] * 16,
    "turn": [0, 180, 0],
    "orbit": {"azimuth": 90, "elevation": -30, "zoom": 2, "shift": [0.5, -0.25]},
    "layer": "normal",
    "size": 384,
    "touches": {
        "light_gain": 1.5,
        "albedo_shift": [0.1, 0, -0.1],
        "lift_shadow": ["thumb", "ring1"],
        "strokes": [{"anchor": 7, "radius": 5, "color": [1, 0, 0.5]}],
        "light": 1,
    },
}


def test_everything_that_a_page_says_is_in_the_scene() -> None:
    right = math.pi / 2
    assert read_scene(WHOLE) == Scene(
        Moment("count", 3),
        ((right, 0.0, -right / 2),) * 16,
        (0.0, math.pi, 0.0),
        Orbit(right, math.radians(-30), 2.0, (0.5, -0.25)),
        "normal",
        384,
        Touches(1.5, (0.1, 0.0, -0.1), (13, 14, 15, 10), (Stroke(7, 0.005, (1.0, 0.0, 0.5)),), 1),
    )


def test_a_picture_is_a_stroke_among_others() -> None:
    strokes = [{"picture": "abc"}, {"anchor": 1, "radius": 2, "color": [0, 0, 0]}]
    read = read_scene({"touches": {"strokes": strokes}}).touches.strokes
    assert read == (Coat("abc"), Stroke(1, 0.002, (0.0, 0.0, 0.0)))


def test_a_view_of_a_training_is_read_or_refused() -> None:
    assert read_view({}) == View(0, "rgb", 256)
    assert read_view({"frame": 7, "layer": "mesh", "size": 64}) == View(7, "mesh", 64)
    for wrong in ({"frame": -1}, {"frame": 1.5}, {"layer": "x"}, {"size": 63}, {"x": 1}, [], None):
        with pytest.raises(SceneError):
            read_view(wrong)


def test_what_is_left_out_is_as_by_default() -> None:
    assert read_scene({}) == Scene()
    assert read_scene({"moment": None, "angles": None}) == Scene()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"colour": 1}, "there is no 'colour'"),
        ({"layer": "depths"}, "layer: expected one of"),
        ({"layer": ["rgb"]}, "layer: expected one of"),
        ({"size": 4096}, "size"),
        ({"size": 255}, "size"),
        ({"size": True}, "size"),
        ({"angles": [[0, 0, 0]] * 15}, "16 rows"),
        ({"angles": [[0, 0]] * 16}, "three numbers"),
        ({"angles": [[0, 0, "1"]] * 16}, "angles"),
        ({"angles": [[0, 0, 1e9]] * 16}, "angles"),
        ({"turn": [0, 0, float("nan")]}, "turn"),
        ({"turn": [0, 0, float("inf")]}, "turn"),
        ({"turn": [10**400, 0, 0]}, "turn"),
        ({"moment": {"motion": "", "step": 0}}, "motion"),
        ({"moment": {"motion": "x" * 41, "step": 0}}, "motion"),
        ({"moment": {"motion": "count", "step": -1}}, "step"),
        ({"moment": {"motion": "count", "step": 0.5}}, "step"),
        ({"orbit": {"zoom": 0}}, "zoom"),
        ({"orbit": {"shift": [0]}}, "two numbers"),
        ({"orbit": []}, "orbit"),
        ({"touches": {"light_gain": -1}}, "light_gain"),
        ({"touches": {"lift_shadow": ["toe"]}}, "choose among"),
        ({"touches": {"lift_shadow": [[]]}}, "names"),
        ({"touches": {"lift_shadow": ["thumb"] * 17}}, "at most 16"),
        ({"touches": {"strokes": [{"anchor": 1}]}}, "radius"),
        ({"touches": {"strokes": [None]}}, "stroke"),
        ({"touches": {"strokes": [{"picture": 7}]}}, "picture: expected a name"),
        ({"touches": {"strokes": [{"picture": "x" * 41}]}}, "picture: expected a name"),
        ({"touches": {"strokes": [{"picture": "x", "anchor": 1}]}}, "there is no 'anchor'"),
        (
            {"touches": {"strokes": WHOLE["touches"]["strokes"] * (MOST_STROKES + 1)}},  # type: ignore[index]
            "strokes",
        ),
        ({"touches": {"paint": "/etc/passwd"}}, "there is no"),
    ],
)
def test_what_is_no_scene_is_refused(change: dict[str, object], message: str) -> None:
    with pytest.raises(SceneError, match=message) as caught:
        read_scene(WHOLE | change)
    assert len(str(caught.value)) < 300 and str(caught.value).isprintable()


@pytest.mark.parametrize(
    "body",
    [b"", b"[]", b"{", b"\xff", b"NaN", b'{"size": NaN}', b"[" * 100_000, b"1" * 50_000, b'"x"'],
)
def test_what_is_no_json_object_is_refused(body: bytes) -> None:
    with pytest.raises(SceneError):
        read_json(body)


def test_scenes_with_anything_anywhere_are_read_or_refused() -> None:
    chance = random.Random(0)
    strange = [None, True, -1, 1e308, "", "x" * 999, [], [[]], {}, {"": None}, 10**30, "NaN", 0.5]

    def spoilt(value: object) -> object:
        if chance.random() < 0.1:
            return chance.choice(strange)
        if isinstance(value, dict):
            return {k: spoilt(v) for k, v in value.items() if chance.random() > 0.05}
        if isinstance(value, list):
            return [spoilt(v) for v in value]
        return value

    read = 0
    for _ in range(2000):
        try:
            read_scene(read_json(json.dumps(spoilt(WHOLE)).encode()))
            read += 1
        except SceneError:
            continue
    assert 0 < read < 2000
