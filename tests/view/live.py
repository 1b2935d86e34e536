"""A real server on a free port, for the tests that meet it from outside."""

from contextlib import AbstractContextManager
from pathlib import Path

import torch

from handavatar.avatar import HandAvatar, RenderSettings
from handavatar.capture.motion import Motion
from handavatar.view.guard import guard_of
from handavatar.view.server import ViewServer, serving
from handavatar.view.studio import Studio

FEW = RenderSettings(num_samples=6, coarse=2, edge_rays=1)


def wave() -> Motion:
    """Five steps in which the fingers close."""
    rotations = torch.zeros(5, 16, 3)
    rotations[:, 1:13, 2] = torch.linspace(0, 0.5, 5)[:, None]
    return Motion(10.0, rotations, torch.zeros(5, 3))


def live_server(
    avatar: HandAvatar, out: Path, token: str = ""
) -> AbstractContextManager[ViewServer]:
    """On loopback, with the motion ``wave``; saves avatars in ``out``."""
    studio = Studio(avatar, {"wave": wave()}, FEW)
    return serving(ViewServer(studio, guard_of("127.0.0.1", token), 0, out))
