"""Pictures of events: what is painted and packed is what other programs read."""

import io

import numpy as np
import pytest
from PIL import Image

from evlcp_sdk.results.picture import EventImage
from evlcp_sdk.values import Events


@pytest.mark.parametrize("size", [(5, 4), (3, 7), (16, 1), (1, 2), (1, 1), (34, 50), (640, 480)])
@pytest.mark.parametrize("density", [0.0, 0.0003, 0.01, 0.3, 3.0])
def test_a_picture_is_read_back(size: tuple[int, int], density: float) -> None:
    width, height = size
    rng = np.random.default_rng(1)
    image, cells = EventImage(width, height), np.zeros((height, width), np.uint8)
    for _ in range(2):
        n = int(width * height * density)
        # Some lie outside.
        x, y, p = rng.integers(0, width + 2, n), rng.integers(0, height + 1, n), rng.integers(0, 2, n)
        image.paint(Events.of(np.arange(n), x, y, p))
        for column, row, sign in zip(x.tolist(), y.tolist(), p.tolist(), strict=True):
            if row < height and column < width:
                cells[row, column] |= 1 << sign
    assert (image.cells == cells).all()
    told = image.png()
    with Image.open(io.BytesIO(told)) as picture:
        picture.load()
        assert picture.mode == "P"
        assert (np.array(picture) == cells).all()
        assert told[24] == 2, "bits a pixel"
        assert picture.getpalette()[:12] == [16, 16, 20, 70, 150, 255, 255, 205, 70, 235, 235, 235]
    image.clear()
    assert not image.cells.any()
