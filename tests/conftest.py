"""What all tests share."""

import pytest
import torch


@pytest.fixture(autouse=True, scope="session")
def one_torch_thread():
    """Nothing here is heavy torch work: more threads would only fight each other, and other processes."""
    torch.set_num_threads(1)
