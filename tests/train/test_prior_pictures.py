"""Pictures of priors: named files, a row per prior, a column per side."""

from pathlib import Path

import numpy as np
from PIL import Image

from handavatar.train.prior import SHIPPED_PRIOR
from handavatar.train.prior_pictures import POSES, PriorPictureOptions, picture_priors


def test_each_pose_becomes_a_picture_of_all_priors_from_four_sides(tmp_path: Path) -> None:
    copy = tmp_path / "other.safetensors"
    copy.write_bytes(SHIPPED_PRIOR.read_bytes())
    options = PriorPictureOptions(
        tmp_path / "pictures", (SHIPPED_PRIOR, copy), 16, 32, level="778", rounds=0, truth=False
    )
    written = picture_priors(options)
    assert [path.stem for path in written] == list(POSES)
    for path in written:
        picture = np.asarray(Image.open(path))
        assert picture.shape == (2 * (32 + 18), 4 * 32, 3)
        first, second = picture[18:50], picture[68:]
        # The same weights under two names look the same; each side shows something on white.
        assert np.array_equal(first, second)
        for side in np.split(first, 4, axis=1):
            assert 0.05 < (side.min(-1) < 250).mean() < 0.9
