"""What a camera above the back of the hand has not seen is named."""

from dataclasses import replace

import torch
from conftest import lit_frame

from handavatar.capture.seen_skin import count_seen_skin, skin_regions
from handavatar.geometry.meshes import vertex_normals
from handavatar.hand.open_hand import load_open_hand

FRAMES = [lit_frame(index, "train", size=96) for index in range(3)]


def test_from_above_the_back_is_seen_and_the_palm_is_not() -> None:
    rig = load_open_hand("778")
    seen = count_seen_skin(rig, torch.zeros(10), FRAMES)
    assert {"palm", "index finger, palm side", "little finger, palm side"} <= set(
        seen.unseen_regions
    )
    assert not {"back", "index finger, back", "ring finger, back"} & set(seen.unseen_regions)
    assert 0.3 < seen.unseen_share < 0.8
    assert int(seen.counts.max()) == len(FRAMES) and int(seen.counts.min()) == 0
    # The camera looks down: whatever it saw looks up, but for what the bent fingers turn.
    normals = vertex_normals(rig.shaped().rest_vertices, rig.faces)
    assert float(normals[seen.counts == len(FRAMES), 1].min()) > -0.5


def test_what_lies_in_unknown_pixels_was_not_seen() -> None:
    rig = load_open_hand("778")
    nothing = [replace(frame, known=torch.zeros_like(frame.known)) for frame in FRAMES]
    assert count_seen_skin(rig, torch.zeros(10), nothing).unseen_share == 1.0
    half = torch.ones_like(FRAMES[0].known)
    half[:48] = False
    less = count_seen_skin(rig, torch.zeros(10), [replace(f, known=half) for f in FRAMES])
    every = count_seen_skin(rig, torch.zeros(10), FRAMES)
    assert bool((less.counts <= every.counts).all()) and less.unseen_share > every.unseen_share


def test_every_vertex_has_one_region_and_the_names_are_right() -> None:
    rig = load_open_hand("778")
    regions = skin_regions(rig)
    assert sum(len(vertices) for vertices in regions.values()) == rig.num_vertices
    places, normals = rig.template_vertices, vertex_normals(rig.template_vertices, rig.faces)
    assert float(normals[regions["back"], 1].min()) > 0
    assert float(normals[regions["palm"], 1].max()) < 0
    index, little = (
        places[regions[f"{name} finger, back"]].mean(0) for name in ("index", "little")
    )
    # The index finger's side towards the thumb looks away from the little finger.
    aside = normals[regions["index finger, thumb's side"]].mean(0)
    assert float(aside @ (index - little)) > 0
    nails = rig.vertex_sets.get("nail_thumb")
    if nails is not None and len(nails):
        of_nail = torch.isin(nails, regions["thumb, nail's side"]).float().mean()
        assert float(of_nail) > 0.5
