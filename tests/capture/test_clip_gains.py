"""The same skin gets the same colour in recordings of other exposure and white balance."""

import torch

from handavatar.capture.clip_gains import match_clips
from handavatar.capture.frames import Frame
from handavatar.geometry.cameras import framing_camera
from handavatar.geometry.rotations import axis_angle_from_matrix, matrix_from_axis_angle
from handavatar.hand.open_hand import load_open_hand
from handavatar.hand.pose import HandPose
from handavatar.hand.rig import Rig
from handavatar.render.rasterize import rasterize


def _frame(rig: Rig, turn: float, clip: int, factors: list[float]) -> Frame:
    """A hand turned about its fingers, in the colour of its places times a camera's factors."""
    pose = HandPose.flat()
    wrist = matrix_from_axis_angle(torch.tensor([turn, 0.0, 0.0]))
    rotations = pose.rotations.clone()
    rotations[0] = axis_angle_from_matrix(wrist)
    pose = HandPose(rotations, torch.tensor([0.0, 0.0, 0.5]))
    hand = rig.shaped()
    vertices = hand.posed(pose).vertices
    camera = framing_camera(vertices, (0.0, 1.0, 0.0), 128, 0.6, 1.2)
    drawn = rasterize(vertices, rig.faces, camera)
    mask = drawn.face_index >= 0
    skin = torch.tensor([150.0, 110.0, 90.0]) + 300 * hand.rest_vertices
    corners = skin[rig.faces[drawn.face_index.clamp_min(0)]]
    image = torch.where(mask[..., None], (drawn.barycentric[..., None] * corners).sum(-2), 0.0)
    colors = (image * torch.tensor(factors)).clamp(0, 255).round().to(torch.uint8)
    return Frame(
        f"{clip}-{round(100 * turn):03d}",
        colors,
        (255 * mask).to(torch.uint8),
        camera,
        pose,
        1.0,
        "train",
        0.0,
        clip=clip,
    )


def test_three_recordings_are_brought_to_one_exposure() -> None:
    rig = load_open_hand("778")
    factors = {0: [1.0, 1.0, 1.0], 1: [0.7, 0.8, 1.0], 2: [1.2, 1.1, 0.9]}
    frames = [
        _frame(rig, turn, clip, factors[clip])
        for clip, turns in ((0, (0.0, 0.3, 0.5)), (1, (0.5, 0.8)), (2, (0.8, 1.2)))
        for turn in turns
    ]
    matched, lone = match_clips(frames, rig, torch.zeros(rig.shape_directions.shape[-1]))
    assert lone == []
    for frame in matched:
        assert torch.allclose(frame.gain, torch.tensor(factors[frame.clip]), rtol=0.03)


def test_recordings_that_share_no_skin_are_named() -> None:
    rig = load_open_hand("778")
    front = [_frame(rig, 0.0, 0, [1.0, 1.0, 1.0])]
    back = [_frame(rig, 3.14159, 1, [0.5, 0.5, 0.5])]
    matched, lone = match_clips(front + back, rig, torch.zeros(rig.shape_directions.shape[-1]))
    assert lone == [1]
    assert torch.equal(matched[1].gain, torch.ones(3))
