"""No distance: for one cluster, and where bearings are all that counts."""

import math
from dataclasses import dataclass
from typing import ClassVar

from evlcp_sdk.air.codebook import Codebook
from evlcp_sdk.plugin.roles import Measure, Ranging
from evlcp_sdk.scene.bar import BarLayout
from evlcp_sdk.scene.camera import CameraModel
from evlcp_sdk.values import FrameView, Range

_NO_RANGE = Range(math.nan, math.nan, 0)


@dataclass(frozen=True)
class NoRanging(Ranging):
    """Gives no distance; takes every layout."""

    measures: ClassVar[bool] = False

    def compile(self, camera: CameraModel, bar: BarLayout, codebook: Codebook) -> Measure:
        """Nothing to precompute."""

        def measure(_: FrameView) -> Range:
            return _NO_RANGE

        return measure
