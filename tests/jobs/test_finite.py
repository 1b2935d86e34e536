"""NaN and infinity are found wherever they are, and nothing else is taken for them."""

import math

import pytest
import torch

from handavatar.jobs.finite import NotFinite, find_not_finite, require_finite


def test_finite_values_of_any_kind_are_none_to_speak_of() -> None:
    values = {
        "weights": torch.randn(3, 4),
        "large": torch.full((8,), 3e38),  # Their sum is not finite, they are.
        "half": torch.full((9,), 6e4, dtype=torch.float16),
        "counts": torch.arange(3),
        "mask": torch.tensor([True]),
        "empty": torch.zeros(0, 3),
        "number": 1.5,
        "whole": 10**400,
        "text": "nan",
        "nothing": None,
        "group": {"lr": 0.1, "betas": (0.9, 0.99), "steps": [1, 2]},
    }
    assert find_not_finite(values) is None
    require_finite(values, "here")


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("kind", [torch.float16, torch.bfloat16, torch.float32, torch.float64])
def test_one_value_of_a_tensor_is_found_and_its_place_named(bad: float, kind: torch.dtype) -> None:
    weights = torch.ones(4, 3, dtype=kind)
    weights[2, 1] = bad
    found = find_not_finite({"fine": torch.ones(2), "layer.weight": weights})
    name = "NaN" if math.isnan(bad) else str(bad)
    assert found == f"layer.weight holds {name} at [2, 1] (1 of 12 values are not finite)"


def test_infinities_that_cancel_are_found() -> None:
    found = find_not_finite({"x": torch.tensor([math.inf, -math.inf])})
    assert found == "x holds inf at [0] (2 of 2 values are not finite)"
    assert find_not_finite({"x": torch.tensor(math.nan)}) == (
        "x holds NaN (1 of 1 values are not finite)"
    )


def test_numbers_deep_inside_are_found() -> None:
    state = {"adam": {"param_groups": [{"lr": 0.1}, {"betas": (0.9, math.nan)}]}}
    assert find_not_finite(state) == "adam.param_groups.1.betas.1 is NaN"


def test_the_error_says_where_and_what_to_do() -> None:
    with pytest.raises(NotFinite) as caught:
        require_finite({"rate": math.inf}, "step 7", "take a smaller one")
    assert (caught.value.found, caught.value.remedy) == (
        "step 7: rate is inf",
        "take a smaller one",
    )
    assert str(caught.value) == "step 7: rate is inf\ntake a smaller one"
    assert str(NotFinite("step 7: rate is inf")) == "step 7: rate is inf"
