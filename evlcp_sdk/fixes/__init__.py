"""Positions as files: CSV, GeoJSON, NMEA-0183, MCAP."""

from evlcp_sdk.fixes.writer import PositionPlan, PositionWriter, attitude_source

__all__ = ["PositionPlan", "PositionWriter", "attitude_source"]
