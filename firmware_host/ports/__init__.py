"""Lines to boards, and which of them answer."""
