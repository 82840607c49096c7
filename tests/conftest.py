"""What all tests share."""

import pytest
import torch


def pytest_configure(config):
    """Without this pytest-benchmark warns, in parallel runs, that it cannot measure."""
    if hasattr(config.option, "benchmark_skip"):
        config.option.benchmark_skip = not config.option.benchmark_only


def pytest_collection_modifyitems(config, items):
    """Skip measurements unless they are asked for (``make bench``), also where pytest-benchmark is not installed."""
    if config.getoption("benchmark_only", False):
        return
    for item in items:
        if "benchmark" in item.fixturenames:
            item.add_marker(pytest.mark.skip(reason="a measurement: make bench"))


@pytest.fixture(autouse=True, scope="session")
def one_torch_thread():
    """Nothing here is heavy torch work: more threads would only fight each other, and other processes."""
    torch.set_num_threads(1)
