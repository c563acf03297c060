"""Roll-outs of an estimated linear model in code space, with calibrated uncertainty (eq. 8, 10).

Codes are float64 and dimensionless; a step is one frame interval; histories are oldest first.
"""
