"""Free memory: the smallest of the machine, its control groups (versions 1 and 2, nested) and the address space."""

import psutil
import pytest

from rsvib_torch.core.free_memory import check_fits, free_memory

GB = 10**9


@pytest.fixture(autouse=True)
def _large_machine(monkeypatch):
    memory = psutil.virtual_memory()._replace(available=100 * GB)
    monkeypatch.setattr(psutil, "virtual_memory", lambda: memory)


def write(root, files):
    for name, text in files.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"{text}\n")


def version_1(root, group, limit, used, cached=0):
    folder = f"sys/fs/cgroup/memory{group}"
    values = {"memory.limit_in_bytes": limit, "memory.usage_in_bytes": used}
    values["memory.stat"] = f"cache {cached + 5}\ninactive_file 7\ntotal_inactive_file {cached}"
    write(root, {f"{folder}/{name}": value for name, value in values.items()})


def version_2(root, group, limit, used, cached=0, high="max"):
    folder = f"sys/fs/cgroup{group}"
    values = {"memory.max": limit, "memory.high": high, "memory.current": used}
    values["memory.stat"] = f"anon 5\ninactive_file {cached}\nactive_file 9"
    write(root, {f"{folder}/{name}": value for name, value in values.items()})


def grouped(root, own):
    write(root, {"proc/self/cgroup": own})


def test_machine_without_control_groups(tmp_path):
    assert free_memory(tmp_path) == 100 * GB
    grouped(tmp_path, "0::/")
    assert free_memory(tmp_path) == 100 * GB


def test_version_1_with_its_cached_files(tmp_path):
    grouped(tmp_path, "5:cpu:/job\n4:memory:/job\n0::/")
    version_1(tmp_path, "/job", 8 * GB, 5 * GB, 1 * GB)
    assert free_memory(tmp_path) == 4 * GB


def test_group_above_has_the_smaller_limit(tmp_path):
    grouped(tmp_path, "4:memory:/user/job")
    version_1(tmp_path, "/user/job", 8 * GB, 1 * GB)
    version_1(tmp_path, "/user", 6 * GB, 4 * GB)
    assert free_memory(tmp_path) == 2 * GB
    grouped(tmp_path, "0::/a/b/c")
    version_2(tmp_path, "/a/b/c", "max", GB)
    version_2(tmp_path, "/a", 5 * GB, 2 * GB, GB)
    assert free_memory(tmp_path) == 4 * GB


def test_version_2_throttles_before_its_limit(tmp_path):
    grouped(tmp_path, "0::/job")
    version_2(tmp_path, "/job", 8 * GB, GB, high=3 * GB)
    assert free_memory(tmp_path) == 2 * GB


@pytest.mark.parametrize("own", ["0::/", "0::/../other", "0::/docker/abc", "0::/docker/abc/not-visible"])
def test_container_shows_its_group_at_the_mount(tmp_path, own):
    """With and without a namespace of its own, /proc names the group of the host, but only its part is mounted."""
    grouped(tmp_path, own)
    version_2(tmp_path, "", 3 * GB, 2 * GB)
    assert free_memory(tmp_path) == GB


def test_limit_that_is_already_exceeded(tmp_path):
    grouped(tmp_path, "0::/job")
    version_2(tmp_path, "/job", GB, 2 * GB)
    assert free_memory(tmp_path) == 0


def test_address_space_is_a_limit(monkeypatch):
    resource = pytest.importorskip("resource")
    monkeypatch.undo()
    used = psutil.Process().memory_info().vms
    monkeypatch.setattr(resource, "getrlimit", lambda _: (used + 10**7, -1))
    assert abs(free_memory() - 10**7) < 10**6
    with pytest.raises(ValueError, match=r"^8 frames need 1 GB of memory, of which .* MB are free; read fewer$"):
        check_fits("8 frames", GB, "read fewer")
