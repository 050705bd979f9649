"""One thread per test process, and no terminal width from outside.

The suite runs two processes, and equal seeds must give equal plans whatever the machine. Tables
must be as wide in a test process as in a pipe, whatever terminal the suite was started in.
"""

import os

import torch

os.environ.pop("COLUMNS", None)
torch.set_num_threads(1)
