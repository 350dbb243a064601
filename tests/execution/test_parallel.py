import threading
import time

import pytest
import threadpoolctl
import torch

from rsvib_torch.execution.parallel import in_parallel, threads_for, without_gradients

CPU = torch.device("cpu")


@pytest.fixture
def two_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


def test_items_are_processed_in_parallel(two_threads):
    both = threading.Barrier(2, timeout=20)  # requires two simultaneous calls, otherwise it breaks

    def work(item):
        both.wait()
        return item, torch.get_num_threads(), torch.is_grad_enabled(), torch.is_inference_mode_enabled()

    assert in_parallel(work, range(4), CPU) == [(item, 1, False, False) for item in range(4)]
    with torch.inference_mode():
        assert in_parallel(work, range(2), CPU) == [(item, 1, False, True) for item in range(2)]
    assert torch.get_num_threads() == 2
    started = []
    later = threading.Thread(target=lambda: started.append(torch.get_num_threads()))
    later.start()
    later.join()
    assert started == [2]


def test_errors_are_raised_and_no_further_item_begins(two_threads):
    both, begun = threading.Barrier(2, timeout=20), []

    def fail(item):
        begun.append(item)
        both.wait()
        raise ValueError(f"no {item}")

    with pytest.raises(ValueError, match=r"no [01]"):
        in_parallel(fail, range(9), CPU)
    assert sorted(begun) == [0, 1]
    assert torch.get_num_threads() == 2


def test_operations_on_small_images_use_one_thread_and_independent_work_uses_all(two_threads):
    small, large = torch.zeros(2, 64, 64), torch.zeros(1, 1, 1).expand(1, 1201, 1201)
    with threads_for(small):
        assert torch.get_num_threads() == 1
        assert len(set(in_parallel(lambda _: (time.sleep(0.05), threading.get_ident())[1], range(2), CPU))) == 2
        assert torch.get_num_threads() == 1
    assert torch.get_num_threads() == 2
    with threads_for(large):
        assert torch.get_num_threads() == 2


def blas_threads():
    return {library["num_threads"] for library in threadpoolctl.threadpool_info() if library["user_api"] == "blas"}


def test_fits_use_one_thread_of_blas():
    allowed = blas_threads()
    with threadpoolctl.threadpool_limits(2, user_api="blas"):
        assert without_gradients(blas_threads)() == {1}
        assert blas_threads() == {2}
    assert blas_threads() == allowed
