"""Messages to packets: what `compose` puts on air is what a receiver reads back, signatures included."""

from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from evlcp_sdk.air.blocks import Kind
from evlcp_sdk.air.signing import TrustedKey, TrustedKeys, make_key
from evlcp_sdk.errors import ConfigError
from evlcp_sdk.link.compose import compose, messages_of, packets_of
from evlcp_sdk.link.resolve import load_link
from evlcp_sdk.scene.sites import BarSite

SITE = BarSite(7, 35.0, 137.0, 50.0)


@pytest.mark.skipif(find_spec("cryptography") is None, reason="needs the extra sign")
def test_a_beacon_is_signed_with_the_key(tmp_path: Path) -> None:
    link = load_link()
    public = make_key(tmp_path / "private.pem")
    beacon, signature = messages_of(
        link, beacon=SITE, user=b"lane 2", key=tmp_path / "private.pem", sequence=3
    )
    assert (beacon.kind, signature.kind, beacon.transmitter_id) == (Kind.BEACON, Kind.SIGNATURE, 7)
    digest = link.block_coder().digest
    assert TrustedKeys([TrustedKey(public)]).check(beacon, digest, signature) is True
    other = messages_of(link, beacon=SITE, user=b"lane 3", sequence=3)[0]
    assert TrustedKeys([TrustedKey(public)]).check(other, digest, signature) is False
    symbols = compose(link, beacon=SITE, user=b"lane 2", key=tmp_path / "private.pem", sequence=3, repeat=2)
    np.testing.assert_array_equal(symbols, packets_of([beacon, signature], link.block_coder(), 2))


def test_a_text_that_is_not_utf8_is_one_line() -> None:
    with pytest.raises(ConfigError, match="text: character 2 is not UTF-8"):
        compose(text="a\udcff")
