"""The light of single LEDs: small spots from which bursts of events of one polarity come, in turn."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from evlcp_sdk.air.codebook import Codebook
from evlcp_sdk.air.frames import PacketFormat
from evlcp_sdk.plugin.roles import Detection, Detector
from evlcp_sdk.scene.camera import CameraModel
from evlcp_sdk.values import Events, Region

_CELL_PX, _FINE_PX = 32, 8
"""Cells in which new spots are looked for, and those in which known ones are."""

_SLOTS_PER_BIT, _LONGEST_SLOT_US = 2, 500
"""An edge wakes its burst within a slot: half a bit, or what a burst takes at the most."""

_LEAST, _PURE = 6, 0.7
"""Events of a burst, and by how much more of them are of one polarity than of the other."""

_TURNS = 6
"""Bursts of the other polarity than the one before, with no long time between, that show a spot."""

_BURST_SHARE = 0.35
"""Bursts of a spot that is known have at least so much of its usual number of events: what the lens scatters
of its edges has a third at the most, and must not be taken for it while it is dark for long."""

_AGILE_US = 4000.0
"""Time in which the image of a light that shakes takes another speed."""

_VEIL_PX, _VEIL = 128.0, 2.5
"""How far around a light lenses scatter some of it, and how much brighter it is than what they make of it."""

_ALIKE, _LEARNT_TURNS = 0.5, 12
"""Correlation with the events of a much brighter light, slot by slot, from which on a light is but what the
lens scatters of it: less than three quarters of its power come at other instants. And turns by which that is
known: with fewer, two lights of random bits are as alike by chance."""

_SCATTERED = 6.0
"""How much brighter a light is than what its halo wakes here and there as the image shakes, which has no
edges to compare: a bright LED at 30 m woke bursts of a ninth of its own."""

_LAG_US = 1000.0
"""How much later dim pixels see an edge than bright ones, at the most."""

_MOST_VEILED = 4
"""Lights, the brightest, that are followed to see whether they have edges of their own: there may be many."""

_LARGE_PX = 64.0
"""Three lights so near one another that none is much brighter are places of one that is larger, as a bar."""

_BESIDE_PX = 48.0
"""How far apart neighbours among the places of one light are at the most: lights are at least 24 px apart, so
that between places further from one another there is room for one more."""

_PART_US = 100_000.0
"""How long a light is still taken for a place of a larger one: such places wander, and come and go."""

_FAINTER = 1.5
"""How much brighter a light is than those that come later and are but scattered by the lens, or its trail:
places of a large light are about as bright as one another, and seen at about one time."""

_YOUNG_US = 6000.0
"""Age from which a light is given: until then others may show that it is a place of a larger one."""

_MOST_GATE_PX = 64.0
"""How far from where it should be a spot is looked for at the most."""

_SIZE_PX = 2.0
"""Root mean square of a light's events about its centre before it is known: a lens' blur of some pixels."""

_BOX_SIZES = 2.5
"""A box reaches so far by that size: 99 of 100 events, were they spread as a normal distribution."""

_LEARN_BURST, _LEARN_SIZE = 0.2, 0.1
"""How much one burst says of the next one's events, and a step of the size: the means of five and of ten."""

_BLUR_PX = 4.0
"""Half of a spot's box beyond the light that is seen: its halo, and the way it makes in a step."""


@dataclass(frozen=True)
class Spots(Detection):
    """Small lights that go on and off, each followed by its bursts, and by its motion while it is on.

    For one LED: rates of bits from a hundred to tens of thousands a second, dark and lit for many bits.
    """

    reach_px: Annotated[float, Field(gt=2, le=64, description="How far from its centre a light is seen.")] = (
        12.0
    )
    speed_px_ms: Annotated[
        float, Field(gt=0, le=50, description="How fast it may move in the image, px a millisecond.")
    ] = 1.5
    fade_us: Annotated[
        int, Field(ge=1000, description="Time without an edge of the light after which it has ended.")
    ] = 500_000
    most: Annotated[int, Field(ge=1, le=256, description="Lights that are followed; the brightest.")] = 16

    def compile(self, camera: CameraModel, codebook: Codebook, packet: PacketFormat) -> Detector:
        """For the size of the sensor and the rate of the bits."""
        chip_us = packet.chip_us
        slot_us = min(chip_us / _SLOTS_PER_BIT, _LONGEST_SLOT_US)
        apart_us = 2 * codebook.longest_gap_chips * chip_us
        return _SpotDetector(self, camera.width, camera.height, slot_us, apart_us)


@dataclass(frozen=True)
class _Spot:
    """A light that is followed.

    Attributes:
        id: Its number.
        t_us: When it was seen last, us.
        x_px: Its column at that time.
        y_px: Its row.
        right: Columns a us that it moves.
        down: Rows a us.
        size_px: Root mean square of how far from its centre events are.
        burst: Usual events of a burst in which the light turns; not of the trail, while bright pixels go on.
        lit: The last burst was ON.
        turned_us: When the polarity of its bursts changed last, us.
        found_us: When it was found, us.
        own: It is no part of what the lens scatters of another, as far as is known.
        alike: Products of its events and a brighter light's by lag, and the squares of either: see `_alike`.
        turns: Its turns beside a much brighter light, at one place beside it.
        off_px: Where that is: (right, down) of the brighter light.
        part_us: When it was seen last that it is a place of a larger light, us.
    """

    id: int
    t_us: float
    x_px: float
    y_px: float
    right: float
    down: float
    size_px: float
    burst: float
    lit: bool
    turned_us: float
    found_us: float
    own: bool = True
    alike: tuple[float, ...] = ()
    turns: int = 0
    off_px: tuple[float, float] = (0.0, 0.0)
    part_us: float = -math.inf


@dataclass(frozen=True)
class _Turns:
    """Bursts of a cell: whether the last was ON, how often that changed, and when it did last, us."""

    lit: bool
    turns: int
    t_us: float


@dataclass(frozen=True)
class _State:
    """Lights that are followed, turns of cells by number, and the number of the next light."""

    spots: tuple[_Spot, ...] = ()
    cells: dict[int, _Turns] = field(default_factory=dict)
    next_id: int = 0


@dataclass(frozen=True)
class _SpotDetector:
    spec: Spots
    width: int
    height: int
    slot_us: float
    apart_us: float

    def init(self) -> _State:
        return _State()

    def step(self, state: _State, start_us: int, events: Events) -> tuple[_State, list[Region]]:
        now_us = float(events.t_us[-1]) if len(events) else float(start_us)
        moved: list[_Spot] = []
        regions: list[Region] = []
        places = self._all_followed(state.spots, start_us, now_us, events)
        for before, (seen, x_px, y_px) in zip(state.spots, places, strict=True):
            beside = any(_apart(x_px, y_px, other) < self.spec.reach_px for other in moved)
            faded = now_us - seen.turned_us > self.spec.fade_us
            if not (beside or faded):
                moved.append(self._judged(before, seen, (x_px, y_px), places, start_us, events))
                regions.append(self._region(seen, x_px, y_px, now_us))
        cells, new = self._turned(state.cells, start_us, events)
        next_id = state.next_id
        for spot in new:
            veil = _brighter(spot, moved) is not None
            gone = self._making_way(spot, moved, veil=veil)
            if gone is None:
                continue
            regions = [region for region in regions if region.id not in {one.id for one in gone}]
            moved = [one for one in moved if one.id not in {other.id for other in gone}]
            moved.append(replace(spot, id=next_id, own=not veil))
            regions.append(self._region(moved[-1], spot.x_px, spot.y_px, now_us))
            next_id += 1
        moved = _with_parts(moved, now_us)
        single = [
            region
            for region, spot in zip(regions, moved, strict=True)
            if spot.own and now_us - spot.found_us >= _YOUNG_US and spot.turned_us - spot.part_us > _PART_US
        ]
        return _State(tuple(moved), cells, next_id), single

    def _making_way(self, spot: _Spot, moved: list[_Spot], *, veil: bool) -> list[_Spot] | None:
        """Which spots, not known to be lights of their own, make way for a new one; None: that does."""
        near = [other for other in moved if _apart(spot.x_px, spot.y_px, other) < 2 * self.spec.reach_px]
        here = any(_apart(spot.x_px, spot.y_px, other) < self.spec.reach_px for other in near)
        if here or any(other.own or veil for other in near):
            return None
        gone = list(near)
        if veil:
            gone += _dimmest([other for other in moved if not other.own], spot, _MOST_VEILED)
        if len(moved) - len(gone) >= self.spec.most:
            gone += _dimmest(moved, spot, self.spec.most)
        return None if any(one is spot for one in gone) else gone

    def _judged(
        self,
        before: _Spot,
        spot: _Spot,
        place: tuple[float, float],
        places: Sequence[tuple[_Spot, float, float]],
        start_us: int,
        events: Events,
    ) -> _Spot:
        """A light with what a step says of whether it is but what the lens scatters of a brighter one."""
        other = _brighter(spot, [one for one, _, _ in places])
        if other is None:
            return spot
        beside = next((x, y) for one, x, y in places if one is other)
        off_px = place[0] - beside[0], place[1] - beside[1]
        off = max(abs(one - then) for one, then in zip(off_px, spot.off_px, strict=True))
        turned = before.lit != spot.lit
        if spot.alike and turned and off > self.spec.reach_px:
            # Two lights shake together; what does not is a halo's.
            return replace(spot, own=False, alike=(), turns=0)
        turns = spot.turns + turned
        # One that was there before is a light of its own until it shows that it is not.
        own = spot.own and (bool(spot.alike) or spot.found_us + _YOUNG_US < other.found_us)
        alike = self._alike(place, beside, start_us, events)
        if spot.alike:
            alike = tuple(one + more for one, more in zip(spot.alike, alike, strict=True))
        if turns >= _LEARNT_TURNS:
            *products, mine, its = alike
            own = other.burst < _SCATTERED * spot.burst and max(products) < _ALIKE * math.sqrt(mine * its)
        return replace(spot, own=own, alike=alike, turns=turns, off_px=spot.off_px if spot.alike else off_px)

    def _alike(
        self, place: tuple[float, float], other: tuple[float, float], start_us: int, events: Events
    ) -> tuple[float, ...]:
        """How alike events are at two places in a step, slot by slot.

        Products of ON less OFF events at the first place with those at the second so many slots before, for
        each lag; and the sums of the squares at either.
        """
        slots = []
        lags = int(_LAG_US / self.slot_us) + 2
        for x_px, y_px in (place, other):
            x, y = np.abs(events.x - x_px), np.abs(events.y - y_px)
            inside = (x <= self.spec.reach_px) & (y <= self.spec.reach_px)
            slot = self._slots(events.t_us[inside], start_us)
            signed = 2.0 * events.p[inside] - 1.0
            slots.append(np.bincount(slot, signed) if len(slot) else np.zeros(1))
        mine, its = (np.pad(one, (0, max(map(len, slots)) - len(one))) for one in slots)
        products = [
            float(mine[max(lag, 0) : len(mine) + min(lag, 0)] @ its[max(-lag, 0) : len(its) - max(lag, 0)])
            if abs(lag) < len(mine)
            else 0.0
            for lag in range(-1, lags)
        ]
        return *products, float(mine @ mine), float(its @ its)

    def _region(self, spot: _Spot, x_px: float, y_px: float, now_us: float) -> Region:
        side = 2 * (min(max(_BOX_SIZES * spot.size_px, _BLUR_PX), self.spec.reach_px) + _BLUR_PX) + 1
        return Region(spot.id, now_us, x_px, y_px, side, side)

    def _all_followed(
        self, spots: Sequence[_Spot], start_us: int, now_us: float, events: Events
    ) -> list[tuple[_Spot, float, float]]:
        """Lights after a step, and where they are in it; dark dim ones take no bright one's events."""
        found: dict[int, tuple[_Spot, float, float]] = {}
        x, y = events.x.astype(np.float64), events.y.astype(np.float64)
        for spot in sorted(spots, key=lambda one: -one.burst):
            brighter = [(x, y) for one, x, y in found.values() if one.burst > _VEIL * spot.burst]
            found[spot.id] = self._followed(spot, start_us, now_us, events, (x, y), brighter)
        return [found[spot.id] for spot in spots]

    def _followed(
        self,
        spot: _Spot,
        start_us: int,
        now_us: float,
        events: Events,
        places: tuple[NDArray[np.float64], NDArray[np.float64]],
        others: Sequence[tuple[float, float]],
    ) -> tuple[_Spot, float, float]:
        """A light after a step, and where it is in it: seen there, or where it should be.

        Events are at these places, columns and rows; what is in reach of the places of others is theirs.
        """
        away_us = max(now_us - spot.t_us, 0.0)
        straight_us = _AGILE_US * (1 - math.exp(-away_us / _AGILE_US))
        x_px, y_px = spot.x_px + spot.right * straight_us, spot.y_px + spot.down * straight_us
        gate_px = min(self.spec.reach_px + self.spec.speed_px_ms * away_us * 1e-3, _MOST_GATE_PX)
        x, y = places
        wanted = (np.abs(x - x_px) <= gate_px) & (np.abs(y - y_px) <= gate_px)
        for u_px, v_px in others:
            wanted &= (np.abs(x - u_px) > self.spec.reach_px) | (np.abs(y - v_px) > self.spec.reach_px)
        near = np.flatnonzero(wanted)
        if len(near) < _LEAST:
            return spot, x_px, y_px
        x, y, t, on = x[near], y[near], events.t_us[near], events.p[near] > 0
        slot = self._slots(t, start_us)
        burst = self._burst(x, y, slot, on, max(_LEAST, _BURST_SHARE * spot.burst), (x_px, y_px, gate_px))
        if burst is not None:
            u_px, v_px, many, lit = burst
            if lit != spot.lit:
                usual = spot.burst + _LEARN_BURST * (many - spot.burst)
                spot = replace(spot, burst=usual, lit=lit, turned_us=now_us)
        elif spot.lit:
            u_px, v_px = x_px, y_px
        else:
            return spot, x_px, y_px
        reach_px = self.spec.reach_px
        for _ in range(2):
            inside = (np.abs(x - u_px) <= reach_px) & (np.abs(y - v_px) <= reach_px)
            if inside.sum() < _LEAST:
                return spot, x_px, y_px
            u_px, v_px = float(x[inside].mean()), float(y[inside].mean())
        t_us = float(t[inside].mean())
        size_px = float(np.sqrt(((x[inside] - u_px) ** 2 + (y[inside] - v_px) ** 2).mean() / 2))
        since_us = max(t_us - spot.t_us, 1.0)
        share = since_us / (since_us + _AGILE_US)
        most = self.spec.speed_px_ms * 1e-3
        right = spot.right + share * ((u_px - spot.x_px) / since_us - spot.right)
        down = spot.down + share * ((v_px - spot.y_px) / since_us - spot.down)
        spot = replace(
            spot,
            t_us=t_us,
            x_px=u_px,
            y_px=v_px,
            right=min(max(right, -most), most),
            down=min(max(down, -most), most),
            size_px=spot.size_px + _LEARN_SIZE * (size_px - spot.size_px),
        )
        return spot, u_px, v_px

    def _burst(
        self,
        x: NDArray[np.float64],
        y: NDArray[np.float64],
        slot: NDArray[np.int64],
        on: NDArray[np.bool_],
        least: float,
        gate: tuple[float, float, float],
    ) -> tuple[float, float, float, bool] | None:
        """The burst of the most events near a place: column, row, how many, and whether ON; None for none."""
        x_px, y_px, gate_px = gate
        cells = int(2 * gate_px / _FINE_PX) + 2
        column = ((x - x_px + gate_px) / _FINE_PX).astype(np.int64)
        row = ((y - y_px + gate_px) / _FINE_PX).astype(np.int64)
        slots = int(slot.max()) + 1
        index = (slot * cells + row) * cells + column
        every = np.bincount(index, minlength=slots * cells * cells).reshape(slots, cells, cells)
        ones = np.bincount(index[on], minlength=slots * cells * cells).reshape(slots, cells, cells)
        every, ones = (many[:, :-1] + many[:, 1:] for many in (every, ones))
        every, ones = (many[..., :-1] + many[..., 1:] for many in (every, ones))
        more = np.abs(2 * ones - every)
        more[more < _PURE * every] = 0
        best = int(more.argmax())
        if more.flat[best] < least:
            return None
        _, v, u = np.unravel_index(best, more.shape)
        # The light is as its last burst left it.
        last = int(np.flatnonzero(more[:, v, u] >= 0.5 * more.flat[best])[-1])
        lit = bool(2 * ones[last, v, u] > every[last, v, u])
        u_px, v_px = x_px - gate_px + (int(u) + 1) * _FINE_PX, y_px - gate_px + (int(v) + 1) * _FINE_PX
        return u_px, v_px, float(more.flat[best]), lit

    def _slots(self, t_us: NDArray[np.int64], start_us: int) -> NDArray[np.int64]:
        """In which slot of a step events are; those from before it are in its first."""
        return np.maximum(np.floor((t_us - start_us) / self.slot_us).astype(np.int64), 0)

    def _turned(
        self, cells: dict[int, _Turns], start_us: int, events: Events
    ) -> tuple[dict[int, _Turns], list[_Spot]]:
        """Cells by the bursts of a step, and lights that they show."""
        known = {cell: turns for cell, turns in cells.items() if start_us - turns.t_us <= self.apart_us}
        if len(events) < _LEAST:
            return known, []
        columns = -(-self.width // _CELL_PX)
        many = columns * -(-self.height // _CELL_PX)
        cell = events.y.astype(np.int64) // _CELL_PX * columns + events.x.astype(np.int64) // _CELL_PX
        slot = self._slots(events.t_us, start_us)
        index = slot * many + cell
        every = np.bincount(index)
        signed = np.bincount(index, 2.0 * events.p.astype(np.float64) - 1.0)
        bursts = np.flatnonzero((every >= _LEAST) & (np.abs(signed) >= _PURE * every))
        new = []
        for at in bursts.tolist():
            which, t_us = at % many, start_us + (at // many + 0.5) * self.slot_us
            lit = bool(signed[at] > 0)
            before = known.get(which)
            if before is None or t_us - before.t_us > self.apart_us:
                known[which] = _Turns(lit, 0, t_us)
            elif before.lit != lit:
                known[which] = _Turns(lit, before.turns + 1, t_us)
                if before.turns + 1 >= _TURNS:
                    inside = index == at
                    place = _median(events.x[inside]), _median(events.y[inside])
                    spot = _Spot(-1, t_us, *place, 0.0, 0.0, _SIZE_PX, float(every[at]), lit, t_us, t_us)
                    new.append(spot)
        return known, sorted(new, key=lambda spot: -spot.burst)


def _median(values: NDArray[np.uint16]) -> float:
    """As NumPy's, which takes ten times as long for some tens of values."""
    ordered, n = np.sort(values), len(values)
    return (int(ordered[(n - 1) // 2]) + int(ordered[n // 2])) / 2


def _brighter(spot: _Spot, others: Sequence[_Spot]) -> _Spot | None:
    """The brightest light that is so near, and so much brighter, that the lens may scatter this one of it."""
    near = [
        other
        for other in others
        if other.burst > _VEIL * spot.burst and _apart(spot.x_px, spot.y_px, other) < _VEIL_PX
    ]
    return max(near, key=lambda other: other.burst, default=None)


def _dimmest(spots: Sequence[_Spot], new: _Spot, most: int) -> list[_Spot]:
    """What must go so that a new light is one of so many: nothing, the dimmest, or the new one itself."""
    if len(spots) < most:
        return []
    least = min(spots, key=lambda one: one.burst)
    return [new] if least.burst >= new.burst else [least]


def _with_parts(spots: Sequence[_Spot], now_us: float) -> list[_Spot]:
    """Lights with when each was seen to be a place of a larger one, by itself or as a neighbour of one."""
    seen_us = [
        now_us if sum(_is_beside(spot, other, _LARGE_PX) for other in spots) >= 2 else spot.part_us
        for spot in spots
    ]
    # From one to the next: the ends of a large light have a neighbour on one side only.
    for k in sorted(range(len(spots)), key=lambda k: -seen_us[k]):
        waiting = [k]
        while waiting:
            part = waiting.pop()
            for j, spot in enumerate(spots):
                if seen_us[j] < seen_us[part] and _is_beside(spot, spots[part], _BESIDE_PX):
                    seen_us[j] = seen_us[part]
                    waiting.append(j)
    return [replace(spot, part_us=then) for spot, then in zip(spots, seen_us, strict=True)]


def _is_beside(spot: _Spot, other: _Spot, reach_px: float) -> bool:
    """Whether another light is as near and as bright as a place of one light that both are of."""
    return (
        other.id != spot.id
        and other.own
        and _apart(spot.x_px, spot.y_px, other) < reach_px
        and other.burst < _VEIL * spot.burst
        and spot.burst < _VEIL * other.burst
        and not (other.found_us > spot.found_us + _YOUNG_US and spot.burst > _FAINTER * other.burst)
    )


def _apart(x_px: float, y_px: float, spot: _Spot) -> float:
    return max(abs(x_px - spot.x_px), abs(y_px - spot.y_px))
