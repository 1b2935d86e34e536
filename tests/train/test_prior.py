"""Pre-training of the occupancy prior: a few steps run, repeat, and refuse broken files."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import get_args

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from told import Told
from torch import Tensor

from handavatar.avatar import CheckpointError
from handavatar.field.decoders import Decoder, untrained_field
from handavatar.field.occupancy import (
    LENGTH_SCALE,
    Occupancy,
    PairOccupancy,
    contains,
    local_points,
)
from handavatar.geometry.meshes import distance_to_mesh, is_inside, sample_surface
from handavatar.hand.open_hand import load_open_hand
from handavatar.hand.parts import POINT_ROUNDS, divide_into_parts, finer_rig
from handavatar.hand.pose import CONNECTED_PAIRS, NUM_BONES, HandPose
from handavatar.hand.pose_sampling import gesture_rotations
from handavatar.hand.rig import PosedHand
from handavatar.jobs.finite import NotFinite, find_not_finite
from handavatar.train import prior
from handavatar.train.labelled_poses import PoseStream, labelled_pose
from handavatar.train.pretraining import OccupancyLoss
from handavatar.train.prior import (
    SHIPPED_PRIOR,
    PriorEvaluationOptions,
    PriorOptions,
    evaluate_prior,
    load_prior,
    open_prior,
    save_prior,
    train_prior,
)
from handavatar.train.stage_times import StageTimes


def _options(out: Path) -> PriorOptions:
    return PriorOptions(out, steps=4, points=128, level="778", rounds=0)


def test_training_repeats_with_its_seed_and_writes_what_it_returns(tmp_path: Path) -> None:
    told = Told()
    fields = [
        train_prior(options, told.progress)
        for options in (
            _options(tmp_path / "a"),
            _options(tmp_path / "b"),
            replace(_options(tmp_path / "c"), seed=1),
        )
    ]
    states = [field.state_dict() for field in fields]
    assert all(torch.equal(states[0][name], states[1][name]) for name in states[0])
    assert not all(torch.equal(states[0][name], states[2][name]) for name in states[0])
    assert told.steps == [0, 1, 2, 3, 4] * 3
    loaded = PairOccupancy()
    load_prior(loaded, tmp_path / "a")
    assert all(torch.equal(value, states[0][name]) for name, value in loaded.state_dict().items())
    with safe_open(tmp_path / "a", framework="pt") as file:
        metadata = file.metadata()
    assert metadata["step"] == "4" and metadata["rig_sha256"] == load_open_hand("778").sha256
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "b", "c"]


def test_training_continues_from_a_prior(tmp_path: Path) -> None:
    options = replace(
        _options(tmp_path / "on"), steps=1, lr=1e-9, final_lr=1e-9, start_from=SHIPPED_PRIOR
    )
    field, shipped = train_prior(options), load_file(SHIPPED_PRIOR)
    # One step moves every weight by about the learning rate at most.
    for name, value in field.state_dict().items():
        torch.testing.assert_close(value, shipped[name], atol=1e-7, rtol=0)


def test_labelled_points_lie_about_the_hand_and_their_labels_are_true() -> None:
    rig = load_open_hand("778")
    parts = divide_into_parts(rig)
    generator = torch.Generator().manual_seed(0)
    sample = labelled_pose(rig, parts, torch.zeros(NUM_BONES, 3), 400, 0.012, generator)
    vertices = sample.posed.sealed_vertices
    assert torch.equal(sample.is_inside, is_inside(vertices, rig.sealed_faces, sample.points))
    assert 0.1 < float(sample.is_inside.float().mean()) < 0.7
    distances = torch.cdist(sample.points, vertices).amin(1)
    assert float(distances.max()) < 0.06
    # Half lie near the surface: 4 mm at most of noise, and vertices some 5 mm apart.
    assert float((distances[200:] < 0.02).float().mean()) > 0.95


def test_a_prior_with_nan_is_neither_written_nor_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    field, rig = PairOccupancy(), load_open_hand("778")
    save_prior(field, _options(tmp_path / "a"), rig, 1)
    before = (tmp_path / "a").read_bytes()
    with torch.no_grad():
        field.encoder.input.weight[3, 2] = float("nan")
    with pytest.raises(
        NotFinite, match=r"a: not saved: encoder\.input\.weight holds NaN at \[3, 2\]"
    ):
        save_prior(field, _options(tmp_path / "a"), rig, 2)
    assert (tmp_path / "a").read_bytes() == before
    with monkeypatch.context() as older:
        older.setattr(prior, "require_finite", lambda *_: None)
        save_prior(field, _options(tmp_path / "a"), rig, 2)
    with pytest.raises(CheckpointError, match=r"encoder\.input\.weight holds NaN at \[3, 2\]"):
        load_prior(PairOccupancy(), tmp_path / "a")


def test_a_prior_that_diverges_says_how_to_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a folder from its last checkpoint, without one from the file, or from the beginning."""
    options = replace(_options(tmp_path / "a"), steps=4, checkpoint_every=2)
    with_folder = replace(options, folder=tmp_path / "run", overwrite=True)
    advance = torch.optim.Adam.step

    def diverging(at: int, state: bool) -> None:
        steps = [0]

        def step(self: torch.optim.Adam, closure: None = None) -> None:
            advance(self)
            steps[0] += 1
            if steps[0] == at:
                parameter = self.param_groups[0]["params"][0]
                spoilt = self.state[parameter]["exp_avg_sq"] if state else parameter.data
                spoilt.view(-1)[0] = float("inf")

        monkeypatch.setattr(torch.optim.Adam, "step", step)

    diverging(1, False)
    with pytest.raises(NotFinite, match=r"step 1: .* holds inf(.|\n)*again with `seed=1`$"):
        train_prior(options)
    assert not (tmp_path / "a").exists()
    # In the last step, and in the optimiser alone.
    diverging(4, True)
    with pytest.raises(NotFinite, match=r"step 4: adam\.\d+\.exp_avg_sq holds inf") as caught:
        train_prior(options)
    assert f"`start_from='{tmp_path / 'a'}'` `overwrite=True` `seed=1`" in str(caught.value)
    diverging(3, False)
    with pytest.raises(NotFinite, match=r"step 3(.|\n)*checkpoint of step 2 is good") as caught:
        train_prior(with_folder)
    assert f"`folder='{tmp_path / 'run'}'` `seed=1`" in str(caught.value)
    monkeypatch.setattr(torch.optim.Adam, "step", advance)
    for again in (
        replace(options, start_from=tmp_path / "a", overwrite=True, seed=1),
        replace(with_folder, seed=1),
        replace(with_folder, seed=1),  # It is the run's own seed by now.
    ):
        assert find_not_finite(train_prior(again).state_dict()) is None
        load_prior(PairOccupancy(), tmp_path / "a")
    with pytest.raises(CheckpointError, match="other options: seed"):
        train_prior(replace(with_folder, seed=2))


def test_broken_priors_are_refused(tmp_path: Path) -> None:
    content = SHIPPED_PRIOR.read_bytes()
    (tmp_path / "cut").write_bytes(content[: len(content) // 2])
    (tmp_path / "noise").write_bytes(b"no weights at all" * 100)
    save_file({"encoder.input.weight": torch.zeros(2, 2)}, tmp_path / "other")
    with pytest.raises(CheckpointError, match="no occupancy prior"):
        load_prior(PairOccupancy(), tmp_path / "missing")
    for name in ("cut", "noise", "other"):
        with pytest.raises(CheckpointError, match=f"{name} is not a usable occupancy prior"):
            load_prior(PairOccupancy(), tmp_path / name)


@pytest.mark.parametrize("decoder", get_args(Decoder))
def test_a_file_knows_its_decoder(tmp_path: Path, decoder: Decoder) -> None:
    options = replace(_options(tmp_path / "a"), steps=2, points=64, decoder=decoder)
    trained = train_prior(options).state_dict()
    opened = open_prior(options.out)
    assert type(opened) is type(untrained_field(decoder))
    assert all(torch.equal(value, trained[name]) for name, value in opened.state_dict().items())
    for other in get_args(Decoder):
        if other != decoder:
            # Shuffled and real pairs have weights of the same shapes, so shapes are no guard.
            with pytest.raises(CheckpointError, match=rf"'{decoder}', expected '{other}'"):
                load_prior(untrained_field(other), options.out, other)
    scores = evaluate_prior(
        PriorEvaluationOptions(options.out, poses=1, points=64, level="778", rounds=0)
    )
    assert 0 <= scores["iou"] <= 1


def test_a_prior_with_an_unknown_decoder_is_refused(tmp_path: Path) -> None:
    save_file({"a": torch.zeros(1)}, tmp_path / "new", {"decoder": "diffusion"})
    with pytest.raises(CheckpointError, match="found the decoder 'diffusion'"):
        open_prior(tmp_path / "new")


def test_the_shipped_prior_knows_poses_it_never_saw() -> None:
    """Four poses say little more than that it is no other file; the figure takes fifty."""
    scores = evaluate_prior(PriorEvaluationOptions(poses=4, points=2048))
    assert scores["iou"] >= 0.95
    assert scores["iou"] == pytest.approx((scores["iou_boxes"] + scores["iou_surface"]) / 2)


def test_at_joints_both_parts_are_asked_and_not_the_deciding_one_alone() -> None:
    """The loss against a loop over the plain decoder, with the same points."""
    rig = load_open_hand("778")
    parts = divide_into_parts(rig)
    field = PairOccupancy()
    load_prior(field)
    stream = PoseStream(rig, rig, parts, field.margin, 64, seed=5, joint_points=40)
    sample = stream.drawn(0, StageTimes())
    without = replace(sample, joint_pairs=sample.joint_pairs[:0])
    loss = OccupancyLoss(field, parts, StageTimes())
    found = float((loss([sample]) - loss([without])).detach())

    codes = field.encode(parts, sample.posed)
    expected = 0.0
    points, labels = sample.points[64:], sample.is_inside[64:]
    for point, label, pair in zip(points, labels, sample.joint_pairs, strict=True):
        if pair < 0:
            continue
        members = torch.tensor(CONNECTED_PAIRS[int(pair)])
        local = local_points(codes.boxes, point[None])
        queries = LENGTH_SCALE * local[0, members]
        logits = field.decoder(codes.part_codes[members][None], queries[None])[0]
        is_in_box = contains(codes.boxes, local)[0, members]
        assert bool(is_in_box.any())
        target = label.float().expand(2)
        each = torch.nn.functional.binary_cross_entropy_with_logits(
            logits, target, reduction="none"
        )
        expected += float(each[is_in_box].sum().detach()) / 80
    assert found == pytest.approx(expected, rel=1e-4)


def test_points_at_joints_are_for_pairs_alone(tmp_path: Path) -> None:
    options = replace(_options(tmp_path / "a"), decoder="coap", joint_points=10)
    with pytest.raises(ValueError, match="`joint_points`: found 10 for the decoder 'coap'"):
        train_prior(options)
    assert not list(tmp_path.iterdir())


def _shipped_on(gesture: str) -> tuple[PosedHand, Callable[[Tensor], Occupancy]]:
    """A hand, and what the shipped prior says of points about it."""
    base = load_open_hand("full")
    rig, parts = finer_rig(base, POINT_ROUNDS)
    posed = rig.shaped().posed(HandPose(gesture_rotations(base, gesture), torch.zeros(3)))
    prior = open_prior()
    assert isinstance(prior, PairOccupancy)
    codes = prior.encode(parts, posed)
    return posed, lambda points: prior(codes, points)


@pytest.mark.parametrize("gesture", ["relaxed", "fist"])
def test_the_shipped_prior_leaves_no_haze_beside_the_hand(gesture: str) -> None:
    """IoU does not see it, but every ray adds it up."""
    posed, occupancy_of = _shipped_on(gesture)
    generator = torch.Generator().manual_seed(0)
    skin = sample_surface(posed.vertices, posed.rig.faces, 8000, generator)
    points = skin.positions(posed.vertices) + 0.008 * torch.randn(8000, 3, generator=generator)
    distances = distance_to_mesh(posed.sealed_vertices, posed.rig.sealed_faces, points)
    inside = is_inside(posed.sealed_vertices, posed.rig.sealed_faces, points)
    far = occupancy_of(points[~inside & (distances > 0.003)]).whole
    assert len(far) > 2000 and float(far.max()) < 2e-3


@pytest.mark.parametrize("gesture", ["flat", "fist"])
def test_the_shipped_prior_has_no_groove_where_parts_meet(gesture: str) -> None:
    """On the skin, where two parts' logits tie, neither falls off: a unit is 0.07 mm."""
    posed, occupancy_of = _shipped_on(gesture)
    skin = sample_surface(
        posed.vertices, posed.rig.faces, 6000, torch.Generator().manual_seed(0)
    ).positions(posed.vertices)
    largest = (torch.logit(occupancy_of(skin).soft_parts, eps=1e-7) / 0.05).topk(2, dim=-1).values
    is_tie = largest[:, 0] - largest[:, 1] < 2
    # Both parts know the skin in a band, not along a line.
    assert float(is_tie.float().mean()) > 0.12
    assert float(largest[is_tie, 0].mean()) > -0.6
