"""Free memory: the smallest of the machine, its control groups (nested) and the address space."""

import psutil
import pytest

from rsvib_torch.files.reading import check_fits, free_memory

GB = 10**9


@pytest.fixture(autouse=True)
def _large_machine(set_free):
    set_free(100 * GB)


def write(root, files):
    for name, text in files.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"{text}\n")


def group(root, folder, limit, used, cached=0, high="max"):
    """Files of a control group."""
    values = {"memory.max": limit, "memory.high": high, "memory.current": used}
    values["memory.stat"] = f"anon 5\ninactive_file {cached}\nactive_file 7"
    write(root, {f"sys/fs/cgroup/{folder}/{name}": value for name, value in values.items()})


@pytest.mark.parametrize(
    ("own", "groups", "free"),
    [
        ("0::/", [], 100),
        ("0::/user/job", [("user/job", 8 * GB, GB), ("user", 6 * GB, 4 * GB)], 2),  # group above
        ("0::/a/b/c", [("a/b/c", "max", GB), ("a", 5 * GB, 2 * GB, GB)], 4),
        ("0::/job", [("job", 8 * GB, GB, 0, 3 * GB)], 2),  # slowed down from memory.high on
        ("0::/job", [("job", GB, 2 * GB)], 0),  # already exceeded
        # containers: /proc names the group of the host, only its part is mounted
        *((f"0::/{name}", [(".", 3 * GB, 2 * GB)], 1) for name in ("", "../other", "docker/abc/not-visible")),
    ],
)
def test_control_groups_limit_the_free_memory(tmp_path, own, groups, free):
    assert free_memory(tmp_path) == 100 * GB
    write(tmp_path, {"proc/self/cgroup": own})
    for arguments in groups:
        group(tmp_path, *arguments)
    assert free_memory(tmp_path) == free * GB


def test_address_space_is_a_limit(monkeypatch):
    resource = pytest.importorskip("resource")
    monkeypatch.undo()
    used = psutil.Process().memory_info().vms
    monkeypatch.setattr(resource, "getrlimit", lambda _: (used + 10**7, -1))
    assert abs(free_memory() - 10**7) < 10**6
    with pytest.raises(ValueError, match=r"^8 frames need 1 GB of memory, of which .* MB are free; read fewer$"):
        check_fits("8 frames", GB, "read fewer")
