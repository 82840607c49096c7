"""The tasks and pairs of tasks of the experiments that no other package has."""
