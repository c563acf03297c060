"""LQR with bounds (eq. 13): build the QP, solve it, check it; say whether a model is fit for it."""
