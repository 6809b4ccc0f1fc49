"""The C code as a library: compiled once, refused with a reason, and of the same bits as tensor code."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from helpers.oracles import confounding, surjective
from torch.fx.experimental.proxy_tensor import make_fx

from ctgraph_rl import Rows
from ctgraph_rl.core import kernel as library
from ctgraph_rl.core import philox, reading


@pytest.fixture
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """An empty cache, and the kernel not yet loaded."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    for made in (library.library, library.is_available):
        made.cache_clear()
    yield tmp_path / "ctgraph_rl"
    for made in (library.library, library.is_available):
        made.cache_clear()


def test_the_kernel_is_compiled_once_into_a_folder_that_is_the_users_alone(own_cache, monkeypatch):
    library.library()
    (made,) = own_cache.iterdir()
    library.library.cache_clear()
    monkeypatch.setattr(library, "_compile", None)

    library.library()

    assert made.suffix == ".so" and own_cache.stat().st_mode & 0o777 == 0o700


@pytest.fixture(scope="module")
def sound(tmp_path_factory) -> bytes:
    """The library, compiled once."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        cache = tmp_path_factory.mktemp("cache")
        monkeypatch.setenv("XDG_CACHE_HOME", str(cache))
        library.library.cache_clear()
        library.library()
    library.library.cache_clear()
    (path,) = (cache / "ctgraph_rl").iterdir()
    return path.read_bytes()


@pytest.fixture
def loaded(sound, own_cache, monkeypatch) -> Path:
    """The library, of which a changed copy fails the test instead of ending the process by SIGBUS when it is loaded."""
    monkeypatch.setattr(library, "_compile", lambda source, compiler, made: made.write_bytes(sound))
    library.library()
    (path,) = own_cache.iterdir()
    load = library.ctypes.CDLL

    def checked(name: str) -> object:
        assert Path(name).read_bytes() == sound, "a changed library was loaded"
        return load(name)

    monkeypatch.setattr(library.ctypes, "CDLL", checked)
    library.library.cache_clear()
    return path


def change(path: Path, content: bytes) -> None:
    """Put another file in the place of a library: the one of this process is mapped into its memory."""
    path.unlink()
    path.write_bytes(content)


@pytest.mark.parametrize("size", [0, 1, 4096, -4096, -1])
def test_a_truncated_library_is_made_again_and_never_loaded(loaded, size):
    sound = loaded.read_bytes()
    change(loaded, sound[:size])

    library.library()

    assert [path.read_bytes() for path in loaded.parent.iterdir()] == [sound]


def test_a_library_with_a_changed_byte_is_made_again_and_never_loaded(loaded):
    sound = loaded.read_bytes()
    change(loaded, sound[:9000] + bytes([sound[9000] ^ 1]) + sound[9001:])

    library.library()

    assert [path.read_bytes() for path in loaded.parent.iterdir()] == [sound]


def test_a_library_reaches_the_disk_before_its_name(loaded, monkeypatch):
    synced = []
    monkeypatch.setattr(
        "ctgraph_rl.disk.os.fsync", lambda number: synced.append(os.readlink(f"/proc/self/fd/{number}"))
    )
    loaded.unlink()

    library.library()

    assert [Path(path).name for path in synced] == ["native.so", "ctgraph_rl"] and loaded.exists()


def test_two_processes_that_compile_at_once_both_get_a_whole_library(loaded, monkeypatch):
    alone, sound = library._compile, loaded.read_bytes()
    change(loaded, sound[:5000])

    def while_another_does(source, compiler, made):
        monkeypatch.setattr(library, "_compile", alone)
        made.write_bytes(sound[:100])
        assert library._made() is not None
        alone(source, compiler, made)

    monkeypatch.setattr(library, "_compile", while_another_does)

    assert library._made() is not None
    assert [path.read_bytes() for path in loaded.parent.iterdir()] == [sound]


def test_a_library_that_another_process_removes_meanwhile_is_made_again(loaded, monkeypatch):
    require_own = library._require_own

    def removed(path: Path) -> None:
        require_own(path)
        loaded.unlink(missing_ok=True)

    monkeypatch.setattr(library, "_require_own", removed)

    library.library()

    assert loaded.exists()


@pytest.mark.parametrize("is_there", [True, False])
def test_from_a_read_only_cache_a_sound_library_is_loaded_and_a_changed_one_is_not(loaded, monkeypatch, is_there):
    if not is_there:
        change(loaded, b"")
    read_only = OSError(errno.EROFS, "Read-only file system", str(loaded))
    for name in ("os.unlink", "os.mkdir", "os.rename", "os.replace"):
        monkeypatch.setattr(
            name, lambda path, *_, **__: raise_(FileExistsError() if Path(path).is_dir() else read_only)
        )

    if is_there:
        library.library()
    else:
        assert not library.is_available()
        with pytest.raises(ValueError, match=r'kernel="required" cannot make or load .* Read-only file system: .*\.so'):
            library.library()


def raise_(error: Exception) -> None:
    raise error


def test_without_a_compiler_all_else_works(own_cache, monkeypatch):
    monkeypatch.setenv("CC", "no-such-compiler")

    tasks = [surjective(), confounding(2, 2, 0.5, read_noise=9)]
    observed = Rows(tasks).reset().observation
    assert not Rows(tasks).uses_kernel
    with pytest.raises(ValueError, match="needs a C compiler, 'no-such-compiler' does not run; install one"):
        Rows([surjective()], kernel="required")
    monkeypatch.undo()
    library.is_available.cache_clear()
    assert Rows(tasks).uses_kernel and torch.equal(Rows(tasks).reset().observation, observed)


def test_a_compiler_that_fails_is_named_with_what_it_said(own_cache, monkeypatch):
    monkeypatch.setattr(library, "_FLAGS", ("-no-such-flag",))

    with pytest.raises(ValueError, match=r'kernel="required": cc -no-such-flag .* failed: \w+: .*no-such-flag'):
        library.library()
    assert not list(own_cache.iterdir())


def test_a_kernel_that_others_could_have_written_is_refused(own_cache):
    library.library()
    own_cache.chmod(0o777)
    library.library.cache_clear()

    with pytest.raises(ValueError, match="must belong to this user and be writable by no other"):
        library.library()


def test_a_cache_that_cannot_be_made_is_refused(own_cache, monkeypatch):
    own_cache.parent.joinpath("file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(own_cache.parent / "file"))

    with pytest.raises(ValueError, match=r"cannot be made .* name your folder"):
        library.library()


def random_words(shape: tuple[int, ...]) -> torch.Tensor:
    return torch.randint(0, 2**32, shape)


@pytest.mark.parametrize("shape", [(), (1,), (63,), (64, 3), (5000,), (0,)])
@pytest.mark.parametrize("own_keys", [False, True])
def test_philox_in_c_has_the_words_of_the_tensor_code(shape, own_keys):
    torch.manual_seed(0)
    counter = (random_words(shape), torch.tensor(7), random_words(shape), random_words((1,)))
    key = tuple(random_words(shape if own_keys else ()) for _ in range(2))
    assert library.takes(*counter, *key)

    words, expected = philox.philox(counter, key), philox.by_tensors(counter, key)

    assert all(torch.equal(word, other.expand_as(word)) for word, other in zip(words, expected, strict=True))
    assert all(word.dtype == torch.int64 and word.shape == torch.broadcast_shapes(shape, (1,)) for word in words)


@pytest.mark.parametrize("size", [(1, 1), (3, 3), (12, 12), (1, 83), (84, 84)])
@pytest.mark.parametrize("count", [1, 2, 130])
def test_noise_in_c_is_that_of_the_tensor_code(size, count):
    torch.manual_seed(0)
    images = torch.randint(0, 256, (count, *size), dtype=torch.uint8).unsqueeze(1)
    start, read_noise = torch.randint(-(2**62), 2**62, (count,)), torch.arange(count) * 2 % 256
    assert library.takes(images, start, read_noise)

    noised = reading.add_noise(images, start, read_noise)

    assert torch.equal(noised, reading.by_parts(images, start, read_noise))


@pytest.mark.parametrize("threads", [1, 2])
def test_threads_change_no_bit_of_the_functions(threads):
    counter = (torch.arange(3 * library.ROWS_A_THREAD), *(torch.tensor(number) for number in (1, 2, 3)))
    key = torch.tensor(4), torch.tensor(5)
    images = torch.full((len(counter[0]), 1, 4, 4), 200, dtype=torch.uint8)
    alone = philox.by_tensors(counter, key)
    before = torch.get_num_threads()

    torch.set_num_threads(threads)
    try:
        words, noised = philox.philox(counter, key), reading.add_noise(images, alone[0], counter[0] % 256)
    finally:
        torch.set_num_threads(before)

    assert all(map(torch.equal, words, alone))
    assert torch.equal(noised, reading.by_parts(images, alone[0], counter[0] % 256))


@pytest.mark.parametrize("break_", ["a noexec mount", "a torn file", "no home"])
def test_whatever_keeps_the_library_from_loading_the_tensor_code_runs(own_cache, monkeypatch, break_):
    def broken(*_: object) -> None:
        raise {"a noexec mount": OSError, "a torn file": OSError, "no home": RuntimeError}[break_](break_)

    monkeypatch.setattr(library.Path, "home" if break_ == "no home" else "exists", broken)
    monkeypatch.delenv("XDG_CACHE_HOME")
    counter, key = (torch.arange(3),) * 4, (torch.tensor(1),) * 2

    assert all(map(torch.equal, philox.philox(counter, key), philox.by_tensors(counter, key)))
    with pytest.raises(
        ValueError, match=f'kernel="required" cannot make or load the kernel: {break_}; use kernel="auto"'
    ):
        library.library()


def test_another_default_device_changes_nothing():
    rows = Rows([confounding(2, 2, 0.5, read_noise=9)] * 3)
    rows.reset()

    with torch.device("meta"):
        words = philox.philox((rows.tick,) * 4, (rows.seed,) * 2)

    assert all(word.is_cpu for word in words)


def test_noise_of_other_shapes_stays_with_the_tensor_code():
    images, start = torch.zeros(3, 1, 2, 2, dtype=torch.uint8), torch.arange(3)

    assert torch.equal(
        reading.add_noise(images, start, torch.tensor([9])), reading.by_parts(images, start, torch.tensor([9] * 3))
    )
    with pytest.raises(RuntimeError):
        reading.add_noise(images, torch.arange(1), torch.full((3,), 9))


def test_what_is_traced_without_torch_compile_is_tensor_code():
    others, key = tuple(torch.arange(3) for _ in range(3)), (torch.tensor(1), torch.tensor(2))

    def words(first: torch.Tensor) -> tuple[torch.Tensor, ...]:
        return philox.philox((first, *others), key)

    for trace in (make_fx(words)(torch.arange(3)), torch.jit.trace(words, (torch.arange(3),))):
        assert all(map(torch.equal, trace(torch.arange(5, 8)), words(torch.arange(5, 8))))


def test_traced_tensors_stay_with_the_tensor_code():
    taken = []

    def one(word: torch.Tensor) -> torch.Tensor:
        taken.append(library.takes(word))
        return word

    torch.vmap(one)(torch.arange(2))
    assert taken == [False]
    assert library.takes(torch.arange(2)) and not library.takes(torch.arange(2, device="meta"))
