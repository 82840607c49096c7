"""A benchmark of transfer between different tasks: methods, pairs of tasks, and the command ``sb3-combrel benchmark``."""
