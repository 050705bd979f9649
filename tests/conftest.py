"""One thread per test process: the suite runs two of them, and equal seeds must give equal plans whatever the machine."""

import torch

torch.set_num_threads(1)
