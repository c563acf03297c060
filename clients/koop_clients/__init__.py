"""Simulators, and everything that talks to the koop service from outside."""
