import json
import math
import struct
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import lit_frame
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from safetensors.torch import load_file, save_file

from handavatar.capture.frames import (
    CaptureError,
    CaptureWriter,
    Frame,
    opencv_from_opengl,
    opengl_from_opencv,
    read_capture,
    write_capture,
)
from handavatar.capture.soundness import find_problems
from handavatar.fit.landmarks import LandmarkSightings
from handavatar.geometry.cameras import Camera, look_at, project
from handavatar.geometry.rotations import matrix_from_axis_angle
from handavatar.hand.pose import HandPose
from handavatar.jobs.files import MARKER

HEADER = dict(
    rig_name="open-hand",
    rig_sha256="0" * 64,
    subject="test",
    source="made in a test",
    licence="CC0-1.0",
)


def make_frame(index: int, split: str = "train") -> Frame:
    generator = torch.Generator().manual_seed(index)
    mask = torch.zeros(6, 8, dtype=torch.bool)
    mask[1 : 3 + index % 2, 2:6] = True
    eye = torch.tensor([0.1 * index, 0.4, 0.1])
    return Frame(
        name=f"{index:06d}",
        image=torch.randint(0, 256, (6, 8, 3), generator=generator, dtype=torch.uint8),
        coverage=mask.byte() * 255,
        camera=Camera(
            focal=(20.0 + index, 21.0),
            center=(3.7, 2.9),
            width=8,
            height=6,
            camera_from_world=look_at(eye, torch.zeros(3), torch.tensor([0.0, 0.0, 1.0])),
        ),
        pose=HandPose(
            torch.randn(16, 3, generator=generator) * 0.3,
            torch.randn(3, generator=generator) * 0.02,
        ),
        confidence=0.5 + 0.1 * index,
        split=split,
        time=index / 30,
    )


@pytest.fixture
def folder(tmp_path):
    frames = [make_frame(0), make_frame(1), make_frame(2, "test")]
    write_capture(tmp_path / "made", frames, shape_coefficients=torch.arange(4.0), **HEADER)
    return tmp_path / "made"


def edited(folder, change):
    """Rewrites transforms.json after ``change(content)``."""
    path = folder / "transforms.json"
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def test_round_trip_keeps_everything(folder):
    capture = read_capture(folder)
    assert capture.split("train") == (0, 1)
    assert capture.split("test") == (2,)
    assert capture.split("val") == ()
    assert (capture.side, capture.subject, capture.color_space) == ("right", "test", "srgb")
    assert torch.equal(capture.shape_coefficients, torch.arange(4.0))
    assert len(capture.sha256) == 64
    for index, split in enumerate(("train", "train", "test")):
        frame, expected = capture.frame(index), make_frame(index, split)
        assert torch.equal(frame.image, expected.image)
        assert torch.equal(frame.coverage, expected.coverage)
        # Rotations and translations are stored as doubles: float32 comes back bit by bit.
        assert torch.equal(frame.pose.rotations, expected.pose.rotations)
        assert torch.equal(frame.pose.translation, expected.pose.translation)
        # Two inversions in double of a float32 rotation that is orthonormal to 1e-7.
        torch.testing.assert_close(
            frame.camera.camera_from_world, expected.camera.camera_from_world, atol=1e-6, rtol=0
        )
        assert frame.camera.focal == expected.camera.focal
        assert frame.camera.center == expected.camera.center
        assert (frame.name, frame.split) == (expected.name, expected.split)
        assert frame.confidence == expected.confidence
        assert frame.time == expected.time
    # Files and ranges are sound; the rig that the header names is nobody's.
    (problem,) = find_problems(folder)
    assert "rig open-hand (000000000000): unknown" in problem.what


def test_the_stored_camera_is_camera_to_world_in_opengl_axes(folder):
    entry = json.loads((folder / "transforms.json").read_text())["frames"][1]
    matrix = np.array(entry["transform_matrix"])
    camera = make_frame(1).camera
    # The eye is the last column, and the camera looks along its own -z.
    np.testing.assert_allclose(matrix[:3, 3], [0.1, 0.4, 0.1], atol=1e-6)
    ahead = torch.tensor(matrix[:3, 3] - 0.5 * matrix[:3, 2]).float()
    pixel, depth = project(camera, ahead)
    torch.testing.assert_close(pixel, torch.tensor(camera.center), atol=1e-4, rtol=0)
    assert float(depth) == pytest.approx(0.5, abs=1e-5)


@settings(max_examples=30, deadline=None)
@given(
    st.lists(st.floats(-3, 3, width=32), min_size=6, max_size=6),
)
def test_axes_conversion_is_its_own_inverse(values):
    transform = torch.eye(4)
    transform[:3, :3] = matrix_from_axis_angle(torch.tensor(values[:3]))
    transform[:3, 3] = torch.tensor(values[3:])
    again = opencv_from_opengl(opengl_from_opencv(transform))
    # Rotation and its transpose in float32: 1e-6 of a length of at most 6.
    torch.testing.assert_close(again, transform, atol=1e-5, rtol=0)


def set_in_frame(index, **values):
    return lambda content: content["frames"][index].update(values)


def set_pose(index, **values):
    return lambda content: content["frames"][index]["hand"].update(values)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (set_in_frame(1, file_path="images/none.png"), "missing"),
        (set_in_frame(1, file_path="../secret.png"), "leaves the capture folder"),
        (set_in_frame(1, file_path="/etc/passwd"), "leaves the capture folder"),
        (set_in_frame(1, file_path="images\\000001.png"), "leaves the capture folder"),
        (set_in_frame(1, file_path=7), "not a text"),
        (set_in_frame(1, mask_path="images/000001.png"), "channels RGB"),
        (set_in_frame(1, file_path="images/000000.png"), "two frames"),
        (set_in_frame(1, w=9), "w is 9"),
        (set_in_frame(1, k1=0.1), "distortion"),
        (set_in_frame(1, fl_x=-2.0), "fl_x"),
        (set_in_frame(1, fl_x=10**400), "fl_x"),
        (set_in_frame(1, split="holdout"), "split"),
        (set_in_frame(1, time=True), "time"),
        (set_in_frame(1, hand=None), "no hand pose"),
        (set_in_frame(1, transform_matrix=np.eye(3).tolist()), "transform_matrix"),
        (set_in_frame(1, transform_matrix=np.diag([2, 1, 1, 1]).tolist()), "transform_matrix"),
        (set_in_frame(1, transform_matrix=np.eye(4).tolist()), "wrist lies"),
        (set_pose(1, rotations=[[90.0, 0.0, 0.0]] * 16), "radians"),
        (set_pose(1, rotations=[[0.0, 0.0, 0.0]] * 15), "rotations"),
        (set_pose(1, translation=[0.0, None, 0.0]), "translation"),
        (set_pose(1, confidence=1.5), "confidence"),
    ],
)
def test_one_bad_frame_is_named_with_a_remedy(folder, change, message):
    edited(folder, change)
    with pytest.raises(CaptureError, match=message) as caught:
        read_capture(folder)
    assert len(str(caught.value).splitlines()) <= 6
    (problem,) = find_problems(folder)
    assert problem.frame
    assert problem.remedy


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c.pop("handavatar"), "no handavatar block"),
        (lambda c: c["handavatar"].update(schema=99), "schema"),
        (lambda c: c["handavatar"].update(side="both"), "side"),
        (lambda c: c["handavatar"].update(rig="mano"), "rig"),
        (lambda c: c["handavatar"].update(color_space="linear"), "color_space"),
        (lambda c: c.update(frames=[]), "frames"),
        (lambda c: c.update(camera_model="OPENCV_FISHEYE"), "camera_model"),
    ],
)
def test_bad_headers_are_refused(folder, change, message):
    edited(folder, change)
    with pytest.raises(CaptureError, match=message):
        read_capture(folder)
    assert len(find_problems(folder)) == 1


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        "{",
        '{"frames": NaN}',
        '{"frames": [], "frames": []}',
        "[" * 100_000,
        '{"a": ' + "9" * 5000 + "}",
    ],
)
def test_bad_json_is_refused(folder, text):
    (folder / "transforms.json").write_text(text)
    with pytest.raises(CaptureError):
        read_capture(folder)


def test_nan_in_a_pose_is_refused(folder):
    path = folder / "transforms.json"
    path.write_text(path.read_text().replace('"confidence": 0.6', '"confidence": NaN'))
    with pytest.raises(CaptureError, match="NaN"):
        read_capture(folder)


def test_all_problems_are_listed(folder):
    edited(folder, lambda c: [frame.update(split="?") for frame in c["frames"]])
    assert [problem.frame for problem in find_problems(folder)] == ["000000", "000001", "000002"]
    with pytest.raises(CaptureError, match="and 2 more"):
        read_capture(folder)


def test_a_mask_of_another_size_is_refused(folder):
    Image.new("L", (8, 7)).save(folder / "masks/000001.png")
    with pytest.raises(CaptureError, match="8 x 7"):
        read_capture(folder)


def test_an_empty_mask_is_a_problem(folder):
    Image.new("L", (8, 6)).save(folder / "masks/000001.png")
    (problem,) = find_problems(folder)
    assert (problem.file, problem.what) == ("masks/000001.png", "the mask is empty")


@pytest.mark.parametrize("linked", ["images/000001.png", "images", "transforms.json"])
def test_links_are_refused(folder, tmp_path, linked):
    (folder / linked).rename(tmp_path / "elsewhere")
    (folder / linked).symlink_to(tmp_path / "elsewhere")
    with pytest.raises(CaptureError, match="link"):
        read_capture(folder)


def test_a_truncated_picture_is_found_by_decoding_only(folder):
    path = folder / "images/000001.png"
    path.write_bytes(path.read_bytes()[:80])
    capture = read_capture(folder)
    with pytest.raises(CaptureError, match="000001"):
        capture.frame(1)
    (problem,) = find_problems(folder)
    assert problem.file == "images/000001.png"


@pytest.mark.filterwarnings("ignore::PIL.Image.DecompressionBombWarning")
@pytest.mark.parametrize("side", [9_000, 60_000])
def test_a_huge_header_is_refused_before_decoding(folder, side):
    header = b"IHDR" + struct.pack(">IIBBBBB", side, side, 8, 2, 0, 0, 0)
    chunk = struct.pack(">I", 13) + header + struct.pack(">I", zlib.crc32(header))
    chunk += struct.pack(">I", 1000) + b"IDAT"
    (folder / "images/000001.png").write_bytes(b"\x89PNG\r\n\x1a\n" + chunk)
    with pytest.raises(CaptureError, match="megapixels"):
        read_capture(folder)


def test_other_picture_formats_are_refused(folder):
    Image.new("RGB", (8, 6)).save(folder / "images/000001.png", format="GIF")
    with pytest.raises(CaptureError, match="not a PNG or JPEG"):
        read_capture(folder)


def test_a_folder_in_use_is_refused(folder, tmp_path):
    with pytest.raises(CaptureError, match="not empty"):
        write_capture(folder, [make_frame(0)], **HEADER)
    assert len(read_capture(folder).records) == 3
    write_capture(folder, [make_frame(0)], overwrite=True, **HEADER)
    assert len(read_capture(folder).records) == 1
    (tmp_path / "precious").mkdir()
    (tmp_path / "precious/letter.txt").write_text("dear")
    with pytest.raises(CaptureError, match="no capture"):
        write_capture(tmp_path / "precious", [make_frame(0)], overwrite=True, **HEADER)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["made", "precious"]


def test_a_scene_of_nerfstudio_is_not_taken_for_a_capture(tmp_path):
    scene = tmp_path / "N"
    scene.mkdir()
    (scene / "notes").write_text("hi")
    for text in ("{}", '{"handavatar": null}', "[" * 100_000, "no JSON"):
        (scene / "transforms.json").write_text(text)
        with pytest.raises(CaptureError, match="holds no capture of this program's making"):
            write_capture(scene, [make_frame(0)], overwrite=True, **HEADER)
        assert (scene / "transforms.json").read_text() == text
    assert (scene / "notes").read_text() == "hi" and list(tmp_path.iterdir()) == [scene]


@pytest.mark.parametrize("is_older", [False, True])
def test_a_capture_with_a_file_of_somebody_elses_is_not_replaced(folder, is_older):
    if is_older:
        (folder / MARKER).unlink()
    (folder / "truth").mkdir()
    (folder / "images/beach.jpg").write_text("dear")
    with pytest.raises(CaptureError, match=r"holds images/beach\.jpg, not written by"):
        write_capture(folder, [make_frame(0)], overwrite=True, **HEADER)
    assert (folder / "images/beach.jpg").read_text() == "dear"
    assert len(read_capture(folder).records) == 3
    (folder / "images/beach.jpg").unlink()
    write_capture(folder, [make_frame(0)], overwrite=True, **HEADER)
    assert len(read_capture(folder).records) == 1


def test_a_capture_is_not_written_over_what_it_is_made_from(folder):
    with pytest.raises(CaptureError, match="what is read"):
        CaptureWriter(folder, overwrite=True, inputs=(folder / "images/000000.png",), **HEADER)


def test_a_link_is_not_replaced(folder, tmp_path):
    link = tmp_path / "link"
    link.symlink_to(folder)
    with pytest.raises(CaptureError, match="is a link"):
        write_capture(link, [make_frame(0)], overwrite=True, **HEADER)
    assert link.is_symlink() and len(read_capture(folder).records) == 3


def test_nothing_half_written_stays(tmp_path):
    with pytest.raises(KeyboardInterrupt), CaptureWriter(tmp_path / "new", **HEADER) as writer:
        writer.add(make_frame(0))
        raise KeyboardInterrupt
    bad = make_frame(1)
    bad.pose.rotations[3, 1] = float("nan")
    with pytest.raises(CaptureError, match="not finite"):
        write_capture(tmp_path / "new", [make_frame(0), bad], **HEADER)
    with pytest.raises(CaptureError, match="frames"):
        write_capture(tmp_path / "new", [], **HEADER)
    assert list(tmp_path.iterdir()) == []


def test_a_failed_overwrite_keeps_what_was_there(folder, tmp_path):
    with pytest.raises(CaptureError):
        write_capture(folder, [], overwrite=True, **HEADER)
    assert len(read_capture(folder).records) == 3
    assert list(tmp_path.iterdir()) == [folder]


def test_further_files_go_along(tmp_path):
    with CaptureWriter(tmp_path / "new", **HEADER) as writer:
        writer.add(make_frame(0))
        writer.file("truth/options.json").write_text("{}")
    assert (tmp_path / "new/truth/options.json").read_text() == "{}"


def test_what_is_known_gains_and_covariances_come_back(tmp_path: Path) -> None:
    frames = []
    for index in range(2):
        frame = make_frame(index)
        known = torch.ones_like(frame.mask)
        known[:, :3] = False
        covariance = torch.eye(51) * (1 + index)
        frames.append(
            replace(frame, known=known, gain=torch.tensor([1.1, 1.0, 0.9]), covariance=covariance)
        )
    capture = write_capture(tmp_path / "c", frames, **HEADER)
    for index, frame in enumerate(frames):
        found = capture.frame(index)
        assert torch.equal(found.known, frame.known)
        assert torch.allclose(found.gain, frame.gain)
        assert torch.equal(found.covariance, frame.covariance)
        # A pixel of which nothing is known is not hand, whatever the mask says.
        assert not bool(found.mask[:, :3].any()) and bool(found.mask.any())


def sighting(index: int, vertices: tuple[int, ...] = ()) -> LandmarkSightings:
    generator = torch.Generator().manual_seed(index)
    count = 21 + len(vertices)
    return LandmarkSightings(
        torch.rand(count, 2, generator=generator),
        torch.rand(count, generator=generator) + 0.1,
        torch.rand(count, generator=generator),
        torch.rand(count, generator=generator) + 0.1,
        torch.rand(21, 3, generator=generator),
        torch.tensor(vertices, dtype=torch.long),
    )


@pytest.mark.parametrize("vertices", [(), (7, 3, 1500)])
def test_landmarks_come_back(tmp_path: Path, vertices: tuple[int, ...]) -> None:
    frames = [replace(make_frame(index), landmarks=sighting(index, vertices)) for index in range(2)]
    capture = write_capture(tmp_path / "c", frames, **HEADER)
    for index, frame in enumerate(frames):
        found = capture.frame(index).landmarks
        for name in ("directions", "errors", "depths", "depth_errors", "offsets", "vertices"):
            assert torch.equal(getattr(found, name), getattr(frame.landmarks, name))
    with pytest.raises(CaptureError, match="1 of 2 frames have landmarks"):
        write_capture(tmp_path / "d", [frames[0], make_frame(1)], **HEADER)
    assert not (tmp_path / "d").exists()


@pytest.mark.parametrize(
    ("change", "what"),
    [
        ({"errors": torch.zeros(2, 21)}, "errors are not above zero"),
        ({"depths": torch.full((2, 21), math.nan)}, "depths has shape .* not finite"),
        ({"directions": torch.zeros(3, 21, 2)}, "directions has shape"),
        ({"offsets": None}, "cannot be read"),
        ({"vertices": torch.zeros(2, 4)}, "directions has shape"),
    ],
)
def test_landmarks_that_do_not_fit_the_frames_are_refused(tmp_path: Path, change, what) -> None:
    frames = [replace(make_frame(index), landmarks=sighting(index)) for index in range(2)]
    capture = write_capture(tmp_path / "c", frames, **HEADER)
    path = tmp_path / "c" / "landmarks.safetensors"
    tensors = {k: v for k, v in (load_file(path) | change).items() if v is not None}
    save_file(tensors, path)
    with pytest.raises(CaptureError, match=what):
        capture.frame(0)
    assert any(what.split()[0] in problem.what for problem in find_problems(tmp_path / "c"))


def test_captures_that_say_nothing_of_it_know_everything(tmp_path: Path) -> None:
    frame = write_capture(tmp_path / "c", [make_frame(0)], **HEADER).frame(0)
    assert bool(frame.known.all()) and frame.covariance is None and frame.landmarks is None
    assert torch.equal(frame.gain, torch.ones(3))
    assert not (tmp_path / "c" / "known").exists()


@pytest.mark.parametrize("gain", [[0.0, 1, 1], [1, 1], [1, 1, 1e9]])
def test_gains_that_make_no_sense_are_refused(tmp_path: Path, gain: list[float]) -> None:
    write_capture(tmp_path / "c", [make_frame(0)], **HEADER)
    file = tmp_path / "c" / "transforms.json"
    content = json.loads(file.read_text())
    content["frames"][0]["gain"] = gain
    file.write_text(json.dumps(content))
    with pytest.raises(CaptureError, match="gain"):
        read_capture(tmp_path / "c")


def test_frames_know_their_clip(tmp_path: Path) -> None:
    frames = [replace(make_frame(index), clip=index // 2) for index in range(3)]
    capture = write_capture(tmp_path / "c", frames, **HEADER)
    assert [capture.frame(index).clip for index in range(3)] == [0, 0, 1]
    assert capture.num_clips == 2
    file = tmp_path / "c" / "transforms.json"
    content = json.loads(file.read_text())
    # Captures of one clip say nothing of it, as those of before did.
    assert "clip" not in content["frames"][0]
    for wrong in (-1, 0.5, 1000, "palm"):
        content["frames"][2]["clip"] = wrong
        file.write_text(json.dumps(content))
        with pytest.raises(CaptureError, match="clip"):
            read_capture(tmp_path / "c")


def test_binning_averages_whole_blocks_and_keeps_the_view() -> None:
    frame = lit_frame(1, "train", size=96)
    known = torch.ones(96, 96, dtype=torch.bool)
    known[10, 20] = False
    frame = replace(frame, known=known)
    small = frame.binned(48)
    assert small.image.shape == (48, 48, 3) and small.camera.width == small.camera.height == 48
    block = frame.image[40:42, 60:62].float().mean((0, 1))
    assert bool(((small.image[20, 30].float() - block).abs() <= 0.5).all())
    assert not bool(small.known[5, 10]) and int((~small.known).sum()) == 1
    assert small.image.dtype == small.coverage.dtype == torch.uint8
    # A point of the hand lies at the same place of the picture.
    point = frame.pose.translation[None]
    large, little = (project(each.camera, point)[0] for each in (frame, small))
    assert torch.allclose(large, 2 * little)
    # As the same hand photographed with half the pixels.
    direct = lit_frame(1, "train", size=48)
    assert float((small.alpha - direct.alpha).abs().mean()) < 0.02


@pytest.mark.parametrize("side", [64, 49, 96, 200])
def test_what_is_not_twice_as_large_stays(side: int) -> None:
    frame = lit_frame(1, "train", size=96)
    assert frame.binned(side) is frame
    assert lit_frame(1, "train", size=50).binned(16).camera.width == 25  # no multiple of 3
