"""Finite-horizon LQR to a target code, with bounds (eq. 13): build the QP, solve it, check it."""
