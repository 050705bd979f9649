import numpy as np

import cdiff_cli as cdiff

g = cdiff.load_constraints("constraints/maze2d-umaze-disc.yaml")
x = np.load("my_trajectories.npy")  # [n, horizon, 4], metres and metres per second
pins = cdiff.Pins.ends(x)  # the first and the last state stay
y = cdiff.project(g.on_segments(), x, pins)  # arrays in, arrays out; torch works too
print(g.worst(x), g.worst(y))  # largest g per trajectory, between waypoints too
