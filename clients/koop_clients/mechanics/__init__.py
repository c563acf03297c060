"""Pinocchio plants, their excitation and their pictures. Pure: no network, no clock, no files."""
