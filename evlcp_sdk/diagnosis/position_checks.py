"""Checks of positions against the stated bars, camera, attitude and satellites."""

from collections.abc import Sequence

from evlcp_sdk.diagnosis.facts import Diagnostic, Facts, Findings
from evlcp_sdk.formatting import format_count

_MAX_IDS = 5
"""Ids that a warning lists; it counts the others."""

_DRIVE_SIGMAS = 3.0
"""Sigmas of an estimated bias from which on it is reported."""

_SUSPECTS = {
    "focal length": "camera.focal_mm, or give camera_sigma.focal_mm, and the drive shows the right one",
    "heading": "--heading-deg, or that of the attitude file: the camera's, clockwise from north",
    "attitude": "pitch and roll, their signs, and how the camera is mounted",
}
"""What to compare where the rest contradicts a part of a position."""


def check_sigmas(facts: Facts) -> Findings:
    """Inputs without a sigma, which are taken as exact."""
    exact = facts.positions["bars_exact"]
    missing = [f"bars {', '.join(map(str, exact))} (position_sigma_m in site.toml)"] if exact else []
    if not facts.link.camera_sigma.is_known:
        missing.append("the camera ([camera_sigma], which evlcp calibrate prints)")
    if missing:
        yield Diagnostic(
            "no-sigma",
            f"positions take as exact what has no sigma: {' and '.join(missing)}; their sigmas and protection"
            " levels hold only if it is",
        )


def _suggest_focal_length(facts: Facts) -> str:
    """The focal length that would fit; empty where none is known."""
    fits_mm, focal_mm = facts.positions.get("focal_mm_fits"), facts.link.camera.focal_mm
    return f"camera.focal_mm = {focal_mm:g}: about {fits_mm:.3g} would fit" if fits_mm else ""


def check_exclusions(facts: Facts) -> Findings:
    """Parts that the rest contradicts."""
    lens = _suggest_focal_length(facts)
    for name, number in facts.positions["excluded"].items():
        steps = [lens] if lens and name != "focal length" else []
        steps.append(_SUSPECTS.get(name, "its place, angles and length, and their sigmas"))
        text = f"{format_count(number, 'position')} without {name}, which the rest contradicts"
        yield Diagnostic("excluded", text, f"compare {'; or '.join(steps)}")


def check_biases(facts: Facts) -> Findings:
    """Biases of bars and camera that the drive shows."""
    focal_mm = facts.link.camera.focal_mm
    for row in facts.positions["learnt"]:
        off, sigma, stated = row["correction"], row["sigma"], row["stated_sigma"]
        if row["determined"] and abs(off) > _DRIVE_SIGMAS * stated:
            yield Diagnostic(
                "learnt",
                f"the drive shows {row['part']}, {row['what']}, {off:+.3g} off what is stated, {stated:.3g}"
                f" (sigma): {abs(off) / stated:.1f} sigmas",
                "compare it with what is there",
            )
        elif row["determined"] and row["what"] == "focal_mm" and abs(off) > _DRIVE_SIGMAS * sigma:
            yield Diagnostic(
                "focal",
                f"the drive shows a focal length of {focal_mm + off:.5g} +- {sigma:.2g} mm, not {focal_mm:g}",
                "camera.focal_mm and camera_sigma.focal_mm may say so",
            )


def check_inputs(facts: Facts) -> Findings:
    """GNSS that contradicts bars, and attitudes and GNSS that do not match the recording."""
    positions = facts.positions
    if number := positions["alarms"].get("contradicted", 0):
        difference = ""
        if positions["gnss_apart_m"] is not None:
            east, north, up = (f"{value:+.3g}" for value in positions["gnss_apart_m"])
            difference = f": it is {east} m east, {north} north, {up} up of them"
        yield Diagnostic(
            "gnss-contradicted",
            f"{format_count(number, 'time')} bars and GNSS contradict one another{difference}",
            "compare heights (above the ellipsoid), the sigmas of both, position.antenna_m, and both clocks",
        )
    clock = "t_us of its file has to be the camera's clock, us"
    if outside := positions["attitude_outside"]:
        text = f"none of the attitude's {outside} lines is within the recording's time"
        yield Diagnostic("attitude-outside", text, clock)
    elif number := positions["attitude_missing"]:
        yield Diagnostic(
            "attitude-missing",
            f"{number} of {facts.positions_tried} positions have no attitude: its file does not reach there,"
            " or lacks lines",
            f"{clock}, from before the first bar to after the last",
        )
    if (number := positions["gnss_outside"]) and not positions["gnss"]:
        yield Diagnostic("gnss-outside", f"none of {number} GNSS fixes is within the recording's time", clock)
    if number := positions["gnss_without_heading"]:
        yield Diagnostic(
            "gnss-without-heading",
            f"{number} GNSS fix{'es' * (number != 1)} not used, as no heading says where the antenna is"
            " (position.antenna_m)",
            "give an attitude with a heading",
        )


def check_sites(facts: Facts) -> Findings:
    """Received ids that belong to no site."""
    positions, step = facts.positions, "compare transmitter_id in site.toml"
    received, unseen = positions["heard"], positions["sites_unseen"]
    if (number := positions["refused"].get("no-site", 0)) and not positions["fixes"]:
        yield Diagnostic(
            "no-site",
            f"{format_count(number, 'position')} refused, as no bar in view stands at a known place;"
            f" received: {_list_ids(sorted(set(received.values()))) or 'no id'}",
            step,
        )
    placed = {*positions["bars"], *positions["sites_contradicted"]}
    unknown = sorted({one for n, one in received.items() if n not in placed})
    if positions["fixes"] and unknown and unseen:
        # Either alone is no fault: an unlisted bar, or a listed bar that is not in view.
        yield Diagnostic(
            "unknown-id",
            f"positions are without {_list_ids(unknown)}, received and in no site;"
            f" {_list_ids(unseen)} of the sites {'were' if len(unseen) > 1 else 'was'} not",
            step,
        )


def _list_ids(ids: Sequence[int]) -> str:
    more = f" and {len(ids) - _MAX_IDS} more" if len(ids) > _MAX_IDS else ""
    return f"id{'s' * (len(ids) > 1)} {', '.join(map(str, ids[:_MAX_IDS]))}{more}" if ids else ""


def check_misfits(facts: Facts) -> Findings:
    """Refused positions, and the parts that would each explain most of them."""
    number = facts.positions["refused"].get("misfit", 0)
    if not number:
        return
    suspects, lens = facts.positions.get("suspects", {}), _suggest_focal_length(facts)
    likely = {name: times for name, times in suspects.items() if 2 * times > number}
    steps = {name: _SUSPECTS.get(name, f"place, angles and length of {name}") for name in likely}
    if lens and "focal length" not in likely:
        # It explains all of them at once, so it is the first to compare.
        likely["focal length"] = number + 1
        steps["focal length"] = lens
    names = sorted(likely, key=lambda name: -likely[name])
    text = f"{format_count(number, 'position')} refused, as bars, attitude and camera contradict one another"
    if names:
        text += f"; another {' or another '.join(names)} would explain it"
    default = "sites, angles and [camera], its focal_mm first, with what is there, and their sigmas"
    yield Diagnostic("misfit", text, f"compare {'; '.join(steps[name] for name in names) or default}")
