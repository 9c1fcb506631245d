"""Codebooks of the firmware; `python -m firmware_host.protocol.generate` writes this file."""

from firmware_host.protocol.generated.requests import Profile

DIGESTS = {
    Profile.WH4X2: bytes.fromhex("168d0d2dc197c75a8587a65d156a2d1633d185a2194fb2f78e4352bf0d278991"),
    Profile.WH8: bytes.fromhex("973a1bf77fffa7ec860e56229005dffd993f7c4309d431f7194ee6aea32d7fd1"),
    Profile.RAW8: bytes.fromhex("ed8f86a7630d827fcfdf956f287ddf92974d62e722bb4e80321f319fa1df1f0c"),
}
"""Digest of each profile's codebook, 32 bytes."""
