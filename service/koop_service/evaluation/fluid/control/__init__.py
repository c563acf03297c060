"""The wake calmed in closed loop through Zenoh: the paper's figure 16 on the real solver."""
