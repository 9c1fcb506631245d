"""Laws of error correction."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from evlcp_sdk.air.frames import symbols_of_bits
from evlcp_sdk.errors import ConfigError
from evlcp_sdk.plugin.roles import Corrected
from evlcp_sdk.rx.receiver import Receiver
from evlcp_sdk.testing.exercises import compile_subject, link_of, require_column
from evlcp_sdk.testing.law import InapplicableLawError, Subject, expect, law
from evlcp_sdk.testing.recordings import bar_in_sight, ideal_events

_LENGTHS = (1, 31, 64, 100, 256, 333, 640, 1025, 1280)
"""Lengths of blocks on air: of the built-in profiles, powers of two, and others."""

_LLR = np.float32(8.0)
"""LLR of a bit received well: wrong once in 3000."""

_BLOCKS = 40
_MAX_RATE = 0.9
"""Message bits per coded bit above which a code can correct no more than a bit or two."""


def _compile_codes(subject: Subject) -> list[Any]:
    """Compile the code for the link's packet, and for each length that is not refused."""
    found = [compile_subject(subject)]
    for n in _LENGTHS:
        try:
            found.append(subject.algorithm.compile(n))
        except ConfigError:
            continue
        expect(found[-1].coded_bits == n, f"compile({n}).coded_bits == {n}, got {found[-1].coded_bits}")
    return found


def _draw_message(code: Any, seed: int = 0) -> NDArray[np.uint8]:
    return np.random.default_rng(seed).integers(0, 2, int(code.message_bits)).astype(np.uint8)


def _to_llr(coded: NDArray[np.uint8]) -> NDArray[np.float32]:
    return ((1 - 2 * coded.astype(np.float32)) * _LLR).astype(np.float32)


def _expect_bits(bits: Any, length: int, name: str) -> None:
    expect(isinstance(bits, np.ndarray) and bits.dtype == np.uint8, f"{name} as a uint8 array")
    expect(bits.shape == (length,), f"{name} of shape ({length},), got {bits.shape}")
    expect((bits <= 1).all(), f"{name} of 0 and 1 only")


def _expect_refusal(call: Any, argument: NDArray[Any], what: str) -> None:
    try:
        call(argument)
    except ConfigError:
        return
    expect(False, f"ConfigError from {what}")


@law("shapes", "uint8 bits of the lengths stated, at any length that is not refused")
def _check_shapes(subject: Subject) -> None:
    for code in _compile_codes(subject):
        expect(0 < code.message_bits <= code.coded_bits, f"1 to {code.coded_bits} message bits")
        coded = code.encode(_draw_message(code))
        _expect_bits(coded, code.coded_bits, "coded bits")
        for llr in (_to_llr(coded), np.zeros(code.coded_bits, np.float32)):
            found = code.decode(llr)
            expect(isinstance(found, Corrected), f"decode() to give Corrected, got {type(found).__name__}")
            _expect_bits(found.bits, code.message_bits, "message bits")
            expect(isinstance(found.ok, bool), f"ok as a bool, got {type(found.ok).__name__}")
            expect(isinstance(found.flipped, int), f"flipped as an int, got {type(found.flipped).__name__}")
        m, n = code.message_bits, code.coded_bits
        for wrong in (m - 1, m + 1):
            _expect_refusal(code.encode, np.zeros(wrong, np.uint8), f"encode() of {wrong} bits, not {m}")
        for wrong in (n - 1, n + 1):
            _expect_refusal(code.decode, np.zeros(wrong, np.float32), f"decode() of {wrong} LLRs, not {n}")


@law("comes-back", "a message comes back from the LLRs of its coded bits, none flipped")
def _check_round_trip(subject: Subject) -> None:
    for code in _compile_codes(subject):
        for seed in range(3):
            sent = _draw_message(code, seed)
            found = code.decode(_to_llr(code.encode(sent)))
            what = f"from clean LLRs of {code.coded_bits} bits"
            expect(found.ok, f"ok {what}")
            wrong = int((found.bits != sent).sum())
            expect(not wrong, f"the message {what}, got {wrong} bits wrong")
            expect(found.flipped == 0, f"no bit flipped {what}, got {found.flipped}")


@law("every-bit", "each message bit changes the coded bits")
def _check_every_bit(subject: Subject) -> None:
    for code in _compile_codes(subject):
        sent = _draw_message(code)
        coded = code.encode(sent)
        for i in range(code.message_bits):
            other = sent.copy()
            other[i] ^= 1
            changed = (code.encode(other) != coded).any()
            expect(changed, f"message bit {i} of {code.message_bits} to change the coded bits")


@law("knows-nothing", "nothing received gives no message")
def _check_erasures(subject: Subject) -> None:
    for code in _compile_codes(subject):
        found = code.decode(np.zeros(code.coded_bits, np.float32))
        expect(not found.ok, f"not ok where none of {code.coded_bits} bits was received")
        expect(found.flipped == 0, f"no bit flipped of none received, got {found.flipped}")


@law("no-message-in-noise", "LLRs of random signs give no message")
def _check_noise(subject: Subject) -> None:
    rng = np.random.default_rng(0)
    for code in _compile_codes(subject):
        for spread in (0.0, 1.0):
            llr = rng.choice([-1.0, 1.0], (_BLOCKS, code.coded_bits)) * np.exp(
                spread * rng.normal(size=(_BLOCKS, code.coded_bits))
            )
            ok = sum(code.decode(row.astype(np.float32)).ok for row in llr)
            expect(not ok, f"no message in random LLRs of {code.coded_bits} bits, got {ok} of {_BLOCKS}")


@law("errors-found", "what passes the check is what was sent, however many bits are wrong")
def _check_error_detection(subject: Subject) -> None:
    rng = np.random.default_rng(0)
    for code in _compile_codes(subject):
        for seed in range(_BLOCKS):
            sent = _draw_message(code, seed)
            coded = code.encode(sent)
            coded[rng.random(code.coded_bits) < 10 ** rng.uniform(-3, 0)] ^= 1
            found = code.decode(_to_llr(coded))
            passed = found.ok and (found.bits != sent).any()
            expect(not passed, f"not ok with a message of {code.message_bits} bits that was not sent")


@law("corrects", "one bit in 100 wrong, or one in 50 not received, is put right and counted")
def _check_correction(subject: Subject) -> None:
    code = compile_subject(subject)
    if code.message_bits > _MAX_RATE * code.coded_bits:
        raise InapplicableLawError(
            f"{code.message_bits} message bits of {code.coded_bits}: no room to correct anything"
        )
    rng = np.random.default_rng(0)
    n = code.coded_bits
    for seed in range(20):
        sent = _draw_message(code, seed)
        llr = _to_llr(code.encode(sent))
        wrong = rng.choice(n, n // 100, replace=False)
        llr[wrong] *= np.float32(-0.5)
        found = code.decode(llr)
        what = f"with {len(wrong)} of {n} bits wrong"
        expect(found.ok and (found.bits == sent).all(), f"the message {what}")
        expect(found.flipped == len(wrong), f"{len(wrong)} flipped {what}, got {found.flipped}")
        llr = _to_llr(code.encode(sent))
        llr[rng.choice(n, n // 50, replace=False)] = 0
        found = code.decode(llr)
        what = f"with {n // 50} of {n} bits not received"
        expect(found.ok and (found.bits == sent).all(), f"the message {what}")
        expect(found.flipped == 0, f"no bit flipped {what}, got {found.flipped}")


@law("clean-link", "messages pass through a clean recording, sent by packets of the link")
def _check_clean_link(subject: Subject) -> None:
    link = link_of(subject)
    require_column(link)
    code = compile_subject(subject)
    sent = [_draw_message(code, seed) for seed in range(3)]
    book = link.codebook
    symbols = np.stack(
        [symbols_of_bits(code.encode(bits), book.bits_per_symbol, book.clusters) for bits in sent]
    )
    receiver = Receiver(link)
    packets = receiver.feed(ideal_events(link, bar_in_sight(link, symbols))) + receiver.close()
    expect(len(packets) == len(sent), f"{len(sent)} packets of a clean recording, got {len(packets)}")
    for i, (packet, bits) in enumerate(zip(packets, sent, strict=True)):
        llr = np.concatenate([frame.soft.llr.ravel() for frame in packet.frames])
        found = code.decode(llr.astype(np.float32))
        expect(found.ok, f"message {i} of a clean recording to pass the check")
        expect((found.bits == bits).all(), f"message {i} of a clean recording as it was sent")


ERROR_CORRECTION = (
    _check_shapes,
    _check_round_trip,
    _check_every_bit,
    _check_erasures,
    _check_noise,
    _check_error_detection,
    _check_correction,
    _check_clean_link,
)
"""Laws of error correction."""
