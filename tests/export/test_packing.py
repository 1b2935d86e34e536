"""Arrays as bytes, and back by somebody else."""

import numpy as np
import pytest
import torch

from handavatar.export.packing import Packed, packed_bytes, quantised


def test_arrays_are_found_where_the_index_says() -> None:
    arrays = {
        "a": Packed(np.arange(3, dtype="u1")),
        "b": Packed(np.array([[1.5, -2.5]], dtype="f4")),
        "c": Packed(np.arange(5, dtype="u2")),
        "d": quantised(torch.tensor([[-1.0, 0.25], [0.5, 1.0]]), "i1"),
    }
    index, content = packed_bytes(arrays)
    assert [entry["name"] for entry in index] == list(arrays)
    for entry in index:
        assert entry["start"] % 4 == 0
        read = np.frombuffer(content, "<" + entry["kind"], entry["count"], entry["start"])
        np.testing.assert_array_equal(read, arrays[entry["name"]].values.flatten())
    assert "scale" not in index[0] and index[3]["scale"] == pytest.approx(1 / 127)
    assert packed_bytes(arrays) == (index, content)


@pytest.mark.parametrize(("kind", "most"), [("i1", 127), ("i2", 32767)])
def test_quantised_values_are_half_a_step_off_at_most(kind: str, most: int) -> None:
    values = torch.randn(500, generator=torch.Generator().manual_seed(0))
    read = quantised(values, kind).read()
    step = float(values.abs().max()) / most
    assert float((read - values).abs().max()) <= 0.5001 * step
    assert not quantised(torch.zeros(4), kind).read().any()


def test_a_kind_without_a_typed_array_is_refused() -> None:
    with pytest.raises(ValueError, match="float64"):
        packed_bytes({"a": Packed(np.zeros(2))})
