"""Files of other tools, made: every layout from the same known poses of a hand of MANO's layout.

Poses, places and shapes are random; the MANO file is the synthetic twin of ``mano_files``, with a
mean pose that curls the fingers as the real one does and components that mix all joints. What a
left hand's file says is written for a left hand; truth is that hand, mirrored.
"""

import json
import pickle
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from mano_files import hand_fields, mirrored_fields, write_mano

from handavatar.geometry.rotations import axis_angle_from_matrix, matrix_from_axis_angle
from handavatar.hand.mano import ManoModel, read_mano
from handavatar.hand.pose import HandPose
from handavatar.hand.pose_sampling import sample_poses
from handavatar.hand.rig import Rig

MIRROR = torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)
TURN = torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)
"""Of axis-angle vectors in the mirror; and OpenGL's axes for OpenCV's."""
FPS = 30.0


def mean_pose() -> np.ndarray:
    """A curl of every finger joint, and a little of everything else."""
    mean = 0.05 * np.random.default_rng(4).standard_normal((15, 3))
    mean[:, 2] += [0.35, 0.75, 0.45] * 4 + [0.1, 0.1, 0.1]
    return mean.ravel()


def write_twin(folder: Path, side: str = "right", **changes: Any) -> Path:
    """``MANO_RIGHT.pkl`` or ``MANO_LEFT.pkl`` with that mean pose."""
    fields = hand_fields() | {"hands_mean": mean_pose()}
    if side == "left":
        fields = mirrored_fields(fields, has_flaw=True)
    name = f"MANO_{side.upper()}.pkl"
    return write_mano(folder / name, side, hands_mean=fields["hands_mean"], **changes)


@dataclass(frozen=True)
class Truth:
    """Poses of a right hand, or of a left one in the mirror; a camera's frame.

    Attributes:
        model: the twin.
        side: of the hand that was filmed.
        rotations: axis-angle, absolute, of the right hand; steps 16 3, double.
        places: translations of the right hand, metres.
        betas: one shape.
    """

    model: ManoModel
    side: str
    rotations: torch.Tensor
    places: torch.Tensor
    betas: torch.Tensor

    @property
    def vertices(self) -> torch.Tensor:
        """Of the right hand, or of the left one in the mirror."""
        shaped = self.model.rig.shaped(self.betas.float())
        return shaped.posed(HandPose(self.rotations.float(), self.places.float())).vertices

    @property
    def own_rotations(self) -> torch.Tensor:
        """As MANO of the hand's own side has them."""
        sign = torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)
        return self.rotations * sign if self.side == "left" else self.rotations

    @property
    def own_places(self) -> torch.Tensor:
        return self.places * MIRROR if self.side == "left" else self.places

    @property
    def wrist(self) -> torch.Tensor:
        """Rest place of the wrist of the hand's own side."""
        joint = self.model.rig.shaped(self.betas.float()).rest_joints[0].double()
        return joint * MIRROR if self.side == "left" else joint

    def relative(self) -> torch.Tensor:
        """Finger poses of the own side from its mean pose, steps 45."""
        sign = torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)
        mean = torch.from_numpy(mean_pose()).view(15, 3)
        mean = mean * sign if self.side == "left" else mean
        return (self.own_rotations[:, 1:] - mean).flatten(1)

    def components(self) -> torch.Tensor:
        """The own side's components, 45 45."""
        rows = torch.from_numpy(hand_fields()["hands_components"])
        sign = torch.tensor([1.0, -1.0, -1.0] * 15, dtype=torch.float64)
        return rows * sign if self.side == "left" else rows


def make_truth(folder: Path, side: str = "right", steps: int = 6, seed: int = 0) -> Truth:
    """A hand of the twin that moves half a metre before a camera."""
    model = read_mano(write_twin(folder, side))
    generator = torch.Generator().manual_seed(seed)
    rotations = sample_poses(model.rig, steps, generator).double()
    rotations[:, 0] = torch.randn(3, generator=generator).double()
    rotations[:, 0] += 0.1 * torch.randn(steps, 3, generator=generator).double()
    places = 0.05 * torch.randn(steps, 3, generator=generator).double()
    places[:, 2] += 0.5
    betas = 0.7 * torch.randn(10, generator=generator).double()
    return Truth(model, side, rotations, places, betas)


def left_rig(fields: dict[str, Any], like: Rig) -> Rig:
    """A left hand as it is, not mirrored: for truth alone."""
    return replace(
        like,
        template_vertices=torch.from_numpy(fields["v_template"]).float(),
        faces=torch.from_numpy(fields["f"].astype(np.int64)),
        shape_directions=torch.from_numpy(fields["shapedirs"]).float(),
        pose_directions=torch.from_numpy(fields["posedirs"]).float(),
    )


def _matrices(truth: Truth, own: bool) -> np.ndarray:
    return matrix_from_axis_angle(truth.own_rotations if own else truth.rotations).numpy()


# --- trackers -------------------------------------------------------------------------------------


def hamer_arrays(truth: Truth) -> dict[str, np.ndarray]:
    """The right hand's rotations for either side; the translation of the picture as it is."""
    matrices = _matrices(truth, own=False)
    steps = len(matrices)
    return {
        "global_orient": matrices[:, :1].astype(np.float32),
        "hand_pose": matrices[:, 1:].astype(np.float32),
        "betas": truth.betas.repeat(steps, 1).numpy().astype(np.float32),
        "right": np.full(steps, float(truth.side == "right")),
        "cam_t_full": truth.own_places.numpy().copy(),
        "img_size": np.tile([1920.0, 1080.0], (steps, 1)),
    }


def wilor_mini_arrays(truth: Truth) -> dict[str, np.ndarray]:
    own = truth.own_rotations.numpy().astype(np.float32)
    return {
        "global_orient": own[:, None, :1],
        "hand_pose": own[:, None, 1:],
        "betas": truth.betas.repeat(len(own), 1).numpy()[:, None],
        "is_right": np.full(len(own), int(truth.side == "right")),
        "pred_cam_t_full": truth.own_places.numpy()[:, None],
        "scaled_focal_length": np.array(37500.0),
    }


def write_hawor(folder: Path, truth: Truth, first: int = 0) -> Path:
    """``cam_space/{0|1}/{a}_{b}.json``; the folder ``cam_space``."""
    matrices = _matrices(truth, own=True)
    steps = len(matrices)
    place = folder / "cam_space" / str(int(truth.side == "right"))
    place.mkdir(parents=True, exist_ok=True)
    content = {
        "init_root_orient": matrices[None, :, 0].tolist(),
        "init_hand_pose": matrices[None, :, 1:].tolist(),
        "init_trans": truth.own_places[None].tolist(),
        "init_betas": truth.betas.repeat(1, steps, 1).tolist(),
    }
    (place / f"{first}_{first + steps - 1}.json").write_text(json.dumps(content))
    return folder / "cam_space"


# --- MANO -----------------------------------------------------------------------------------------


def smplx_arrays(truth: Truth) -> dict[str, np.ndarray]:
    """Absolute axis-angle."""
    return {
        "global_orient": truth.own_rotations[:, 0].numpy(),
        "hand_pose": truth.own_rotations[:, 1:].flatten(1).numpy(),
        "betas": truth.betas.numpy(),
        "transl": truth.own_places.numpy(),
        "fps": np.array(FPS),
    }


def arctic_fields(truth: Truth) -> dict[str, dict[str, np.ndarray]]:
    steps = len(truth.rotations)
    hand = {
        "rot": truth.own_rotations[:, 0].numpy(),
        "pose": truth.relative().numpy(),
        "trans": truth.own_places.numpy(),
        "shape": truth.betas.numpy(),
        "fitting_err": np.full(steps, 1e-3),
    }
    return {truth.side: hand}


def interhand_frames(truth: Truth) -> dict[str, Any]:
    """Every third frame of one capture, the other hand not there."""
    other = "left" if truth.side == "right" else "right"
    frames = {}
    for step in range(len(truth.rotations)):
        pose = torch.cat([truth.own_rotations[step, 0], truth.relative()[step]])
        hand = {
            "pose": pose.tolist(),
            "shape": truth.betas.tolist(),
            "trans": truth.own_places[step].tolist(),
        }
        frames[str(1200 + 3 * step)] = {truth.side: hand, other: None}
    return {"0": frames}


def pca_arrays(truth: Truth, flat: bool) -> dict[str, np.ndarray]:
    """45 components, as DexYCB has them, or counted from flat."""
    fingers = truth.own_rotations[:, 1:].flatten(1) if flat else truth.relative()
    coefficients = fingers @ torch.linalg.inv(truth.components())
    return smplx_arrays(truth) | {"hand_pose": coefficients.numpy()}


def save_pickled(path: Path, content: Any) -> Path:
    """As ``numpy.save`` writes a dictionary."""
    np.save(path, np.array(content, dtype=object), allow_pickle=True)
    return path


def save_pickle(path: Path, content: Any) -> Path:
    path.write_bytes(pickle.dumps(content, 4))
    return path


# --- bodies ---------------------------------------------------------------------------------------


def amass_arrays(truth: Truth, rate: float = 120.0) -> dict[str, np.ndarray]:
    """Both hands there; the other one moves its own way."""
    steps = len(truth.rotations)
    poses = 0.3 * np.random.default_rng(1).standard_normal((steps, 156))
    where = slice(66, 111) if truth.side == "left" else slice(111, 156)
    poses[:, where] = truth.own_rotations[:, 1:].flatten(1).numpy()
    return {
        "trans": np.random.default_rng(2).standard_normal((steps, 3)),
        "gender": np.array("female"),
        "mocap_framerate": np.array(rate),
        "betas": np.zeros(16),
        "dmpls": np.zeros((steps, 8)),
        "poses": poses,
    }


def nearest_matrices(vectors: torch.Tensor) -> torch.Tensor:
    """Rotations, for comparing axis-angle vectors of half turns."""
    return matrix_from_axis_angle(vectors.double())


def vectors_of(matrices: torch.Tensor) -> torch.Tensor:
    return axis_angle_from_matrix(matrices)
