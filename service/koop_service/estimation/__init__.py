"""Streaming estimation of each trajectory's linear model: pure functions and values over arrays.

Notation (math.md of the paper's eq. 5 to 7): code size n, history h, control size p, regressor
size d = h*n + p (+ 1 when affine); w_t = [z_{t-h+1}; ...; z_t; u_t; 1?] and y_t = z_{t+1}.
"""
