"""The sections of a link that are not algorithms: the air, regions, messages, positions."""

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from evlcp_sdk.air.frames import PacketFormat
from evlcp_sdk.air.signing import TrustedKey


@dataclass(frozen=True)
class AirSpec:
    """What is on air: the rate of the chips and the length of a packet."""

    chip_rate_hz: Annotated[float, Field(ge=1, le=1e7, description="Chips sent a second.")] = (
        PacketFormat.chip_rate_hz
    )
    frames_per_packet: Annotated[int, Field(gt=0, le=4096, description="Frames between two preambles.")] = (
        PacketFormat.frames
    )
    pilot_every: Annotated[
        int, Field(gt=0, le=64, description="Frames from one pilot to the next; 1: every frame has one.")
    ] = PacketFormat.pilot_every


@dataclass(frozen=True)
class MessageSpec:
    """How messages are read from packets, and whose beacons are verified."""

    decode: Annotated[
        bool, Field(description="Whether to read messages; without, packets are symbols only.")
    ] = True
    combine_packets: Annotated[
        int,
        Field(ge=0, le=256, description="Undecoded blocks kept for combination with repetitions; 0: none."),
    ] = 16
    trusted_keys: Annotated[
        tuple[TrustedKey, ...],
        Field(description="Public Ed25519 keys whose beacons are verified, and what each may sign."),
    ] = ()
    revoked_keys: Annotated[
        tuple[str, ...], Field(description="Public keys whose beacons count as forged, whenever signed.")
    ] = ()
    max_age_s: Annotated[
        float,
        Field(ge=0, description="Longest time from signature to reception of a verified beacon; 0: any."),
    ] = 0.0
    oldest_sequence: Annotated[
        int, Field(ge=0, lt=2**32, description="Sequence below which a signed beacon counts as replayed.")
    ] = 0


@dataclass(frozen=True)
class RegionSpec:
    """How blinking regions are found and followed in the image."""

    step_us: Annotated[
        int, Field(ge=200, le=10_000, description="Time step of the detector; results come once a step.")
    ] = 1500
    min_score: Annotated[
        int,
        Field(ge=2, le=40, description="Score at which a pixel is a candidate: 2 for each run of one chip."),
    ] = 8
    merge_px: Annotated[
        int, Field(ge=1, le=256, description="Gap below which two blinking areas are one region.")
    ] = 11
    fade_us: Annotated[
        int, Field(ge=1000, description="Time without blinking after which a region is released.")
    ] = 50_000


@dataclass(frozen=True)
class PositionSpec:
    """How positions are computed from the image points of bars at known places."""

    max_sigma_m: Annotated[
        float, Field(gt=0, description="Largest sigma, in any direction, of a position that is reported.")
    ] = 3.0
    false_alarm: Annotated[
        float,
        Field(ge=1e-12, le=0.1, description="Probability that the tests of a faultless fix find a fault."),
    ] = 1e-4
    risk: Annotated[
        float,
        Field(ge=1e-12, le=0.1, description="Probability of an error above a protection level with a fault."),
    ] = 1e-4
    bar_fault_m: Annotated[
        float,
        Field(
            ge=0,
            description="Sigma of a bar's unknown displacement from its site, for which protection levels"
            " hold; 0: any displacement.",
        ),
    ] = 0.0
    attitude_fault_deg: Annotated[
        float,
        Field(
            ge=0,
            le=90,
            description="Sigma of an unknown error of an attitude's angle for which protection levels hold;"
            " 0: any error.",
        ),
    ] = 1.0
    focal_fault: Annotated[
        float,
        Field(ge=0, le=1, description="The same of the focal length, as a share of it; 0: any error."),
    ] = 0.005
    max_protection_m: Annotated[
        float, Field(gt=0, description="Largest protection level that is reported.")
    ] = 50.0
    beacons: Annotated[
        Literal["none", "verified", "any"],
        Field(
            description="Beacons whose position is used if no site has their id; with none, they do not"
            " contradict sites, either."
        ),
    ] = "verified"
    beacon_sigma_m: Annotated[
        float,
        Field(ge=0, description="Sigma of a beacon's position to the east, north and up."),
    ] = 0.1
    rate_sigma_deg_s: Annotated[float, Field(gt=0, description="Sigma of the bias of an IMU's rates.")] = 0.1
    gnss_sigma_m: Annotated[
        float,
        Field(
            ge=0,
            le=1e4,
            description="Sigma of an NMEA fix without GST, east and north; up is twice that; 0: none.",
        ),
    ] = 0.0
    antenna_m: Annotated[
        tuple[float, float, float],
        Field(description="Position of the GNSS antenna from the camera: right, down, forward, m."),
    ] = (0.0, 0.0, 0.0)
