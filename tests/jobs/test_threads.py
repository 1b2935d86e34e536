"""Work that is shared out among threads, and torch's own threads meanwhile."""

import pytest
import torch

from handavatar.jobs.threads import mapped, one_thread


@pytest.fixture
def three_threads() -> object:
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    yield
    torch.set_num_threads(before)


@pytest.mark.usefixtures("three_threads")
def test_torch_has_one_thread_inside_and_as_many_as_before_after() -> None:
    with one_thread():
        assert torch.get_num_threads() == 1
    assert torch.get_num_threads() == 3
    with pytest.raises(KeyError), one_thread():
        raise KeyError
    assert torch.get_num_threads() == 3


@pytest.mark.usefixtures("three_threads")
def test_results_come_in_order_without_gradient_and_threads_come_back() -> None:
    weight = torch.ones(3, requires_grad=True)
    results = mapped(lambda piece: (piece * weight).sum(), [1.0, 2.0, 3.0, 4.0])
    assert [float(result) for result in results] == [3, 6, 9, 12]
    assert not any(result.requires_grad for result in results)
    assert torch.get_num_threads() == 3
    assert torch.is_grad_enabled()
