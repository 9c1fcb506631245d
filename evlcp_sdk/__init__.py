"""Visible-light communication and positioning with event cameras."""
