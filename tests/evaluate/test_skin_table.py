"""The table of skinning weights."""

import json
from pathlib import Path

import pytest
import torch

from handavatar import cli
from handavatar.evaluate.skin_table import measure_skin, with_interval
from handavatar.evaluate.tables import ResultTable
from handavatar.hand.detail import refined, subdivided
from handavatar.hand.open_hand import load_open_hand
from handavatar.hand.pose import NUM_BONES


def test_a_mesh_is_at_no_distance_from_itself_and_a_turned_hand_measures_the_same() -> None:
    rig = load_open_hand("778")
    rotations = torch.zeros(2, NUM_BONES, 3)
    rotations[1, 0] = torch.tensor([0.5, -1.0, 2.0])
    measures = measure_skin(rig, rig, rig.skin_weights, rotations)
    # float32 places of 0.2 m are rounded to about 1e-8 m.
    assert float(measures.distance.max()) < 3e-8
    assert float(measures.laplacian[0]) == pytest.approx(float(measures.laplacian[1]), rel=1e-4)


def test_measures_agree_with_a_loop_over_neighbours() -> None:
    base = load_open_hand("778")
    fine = subdivided(base, 1)
    measures = measure_skin(base, fine, fine.skin_weights, torch.zeros(1, NUM_BONES, 3))
    neighbours: list[set[int]] = [set() for _ in range(fine.num_vertices)]
    for face in fine.faces.tolist():
        for vertex in face:
            neighbours[vertex] |= set(face) - {vertex}
    places = fine.template_vertices
    around = [places[sorted(group)] for group in neighbours]
    mean = sum(float((g.mean(0) - p).norm()) for g, p in zip(around, places, strict=True))
    edge = sum(float((g - p).norm(dim=-1).mean()) for g, p in zip(around, places, strict=True))
    assert float(measures.laplacian[0]) == pytest.approx(mean / len(places), rel=1e-3)
    assert float(measures.edge[0]) == pytest.approx(edge / len(places), rel=1e-3)
    non_zero = sum(bool(w) for w in fine.skin_weights.flatten().tolist())
    assert measures.non_zero == pytest.approx(non_zero / fine.skin_weights.numel())


def test_the_interval_is_students() -> None:
    values = torch.tensor([1.0, 2.0, 3.0, 4.0])
    # t(0.975, 3) = 3.18245; the standard error is sqrt(5/3)/2.
    assert with_interval(values) == "2.500 ± 2.054"
    assert with_interval(values - 4, True) == "-1.500 ± 2.054"


def test_a_table_is_markdown_and_json() -> None:
    table = ResultTable("T", {"a": {"x": 1.5, "y": None}, "b": {"x": "2 ± 1", "y": 3}}, ("Note.",))
    lines = table.markdown().splitlines()
    assert lines[:5] == ["### T", "", "| | x | y |", "|---|---|---|", "| a | 1.5 | – |"]
    assert json.loads(json.dumps(table.record()))["rows"]["b"]["y"] == 3


@pytest.mark.slow
def test_bench_makes_the_table_on_a_tiny_budget(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    out = tmp_path / "skin.md"
    words = "bench --table skin --rounds 1 --steps 2 --refit-steps 1 --poses 2 --seeds 0,1 --json"
    assert cli.main([*words.split(), "--out", str(out)]) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert len(rows) == 8 and rows["coarse"]["Cham"] is None
    assert rows["ours, fitted again"]["most bones"] <= 4
    assert out.read_text(encoding="utf-8").startswith("### Skinning weights, open hand 778")


def test_bench_names_its_tables(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["bench"]) == 2
    assert "skin" in capsys.readouterr().err
    assert cli.main(["bench", "--table", "hair"]) == 2
    assert "'hair'" in capsys.readouterr().err
    assert cli.main(["bench", "--help"]) == 0


@pytest.mark.slow
def test_rig_refine_writes_weights_that_a_rig_takes(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    out = tmp_path / "skin.safetensors"
    words = "rig refine --level 778 --rounds 1 --steps 3 --refit-steps 2 --json --out"
    assert cli.main([*words.split(), str(out)]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["figures"]["fitted again"]["most_bones"] <= 4
    rig = load_open_hand("778")
    assert not torch.equal(refined(rig, 1, out).skin_weights, subdivided(rig, 1).skin_weights)
    assert [path.name for path in tmp_path.iterdir()] == ["skin.safetensors"]
