import torch

from handavatar.geometry.colors import eight_bits, linear_from_srgb, srgb_from_linear


def test_stored_colors_and_light_are_inverse() -> None:
    values = torch.linspace(0, 1, 256)
    torch.testing.assert_close(
        srgb_from_linear(linear_from_srgb(values)), values, atol=1e-5, rtol=0
    )


def test_light_is_clipped_and_middle_grey_is_a_fifth_of_white() -> None:
    ends = srgb_from_linear(torch.tensor([-1.0, 2.0]))
    torch.testing.assert_close(ends, torch.tensor([0.0, 1.0]), atol=1e-6, rtol=0)
    # 119 of 255 stores 18 % of white's light, by the standard's own table.
    assert abs(float(linear_from_srgb(torch.tensor(119 / 255))) - 0.184) < 1e-3


def test_pictures_store_what_lies_between_black_and_white() -> None:
    values = torch.tensor([-0.5, 0.0, 0.4 / 255, 0.6 / 255, 0.5, 1.0, 7.0])
    assert eight_bits(values).tolist() == [0, 0, 0, 1, 128, 255, 255]
