"""Process settings: the place of the cache, and an allocator call that never raises."""

import sys

import jax
import pytest

from geosplat_jax.fit import runtime


@pytest.fixture
def cache_setting():
    previous_directory = jax.config.jax_compilation_cache_dir
    yield
    jax.config.update("jax_compilation_cache_dir", previous_directory)


def test_the_cache_is_kept_apart_by_version_and_processor(monkeypatch, tmp_path, cache_setting):
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    directories = []
    for flags in ("flags: avx2", "flags: avx512"):
        monkeypatch.setattr(runtime, "_cpu_flags", lambda flags=flags: flags)
        runtime.enable_compilation_cache()
        directories.append(jax.config.jax_compilation_cache_dir)
    assert directories[0] != directories[1]
    assert all(directory.startswith(str(tmp_path)) for directory in directories)


def test_a_cache_chosen_by_the_user_is_respected(monkeypatch, cache_setting):
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "/elsewhere")
    previous_directory = jax.config.jax_compilation_cache_dir
    runtime.enable_compilation_cache()
    assert jax.config.jax_compilation_cache_dir == previous_directory


def test_a_user_without_a_home_has_no_cache(monkeypatch, cache_setting):
    def fails():
        raise RuntimeError("Could not determine home directory.")

    for name in ("JAX_COMPILATION_CACHE_DIR", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(runtime.Path, "home", fails)
    previous_directory = jax.config.jax_compilation_cache_dir
    runtime.enable_compilation_cache()
    assert jax.config.jax_compilation_cache_dir == previous_directory


def test_programs_are_forgotten_when_they_hold_too_many_maps(monkeypatch):
    double = jax.jit(lambda x: 2 * x)
    double(jax.numpy.ones(3))
    monkeypatch.setattr(runtime, "_CROWDED", 1.0)  # whatever earlier tests have compiled
    assert runtime.release_programs_when_crowded() is False
    assert double._cache_size() == 1
    monkeypatch.setattr(runtime, "_CROWDED", 0.0)
    assert runtime.release_programs_when_crowded() is sys.platform.startswith("linux")
    assert double._cache_size() == (0 if sys.platform.startswith("linux") else 1)
