"""Errors for optional packages say whether the package is missing or broken."""

import sys

import pytest

from geosplat_jax.io.extras import optional_package
from geosplat_jax.io.images import SceneError

pytestmark = pytest.mark.usefixtures("products_must_ask")


def test_a_missing_package_is_named_with_the_extra_that_installs_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "pxr", None)
    with pytest.raises(
        SceneError, match=r"^USD needs the package usd-core; install it with"
    ) as error_info:
        optional_package("pxr", "USD", extra="usd", package="usd-core")
    assert "pip install 'geosplat_jax[usd]'" in str(error_info.value)


@pytest.mark.parametrize(
    ("source", "reason"),
    [
        ("import absent_library_of_the_test", "No module named 'absent_library_of_the_test'"),
        ("raise ImportError('libGL.so.1: cannot open shared object file')", "libGL.so.1"),
    ],
    ids=["a module that it needs is missing", "its library does not load"],
)
def test_a_package_that_cannot_be_imported_is_not_called_missing(
    tmp_path, monkeypatch, source, reason
):
    (tmp_path / "broken_package_of_the_test.py").write_text(source)
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(SceneError, match="is installed but cannot be imported") as error_info:
        optional_package("broken_package_of_the_test", "USD", extra="usd")
    assert reason in str(error_info.value)
    assert isinstance(error_info.value.__cause__, ImportError)


def test_the_caller_chooses_the_class_of_the_error(monkeypatch):
    monkeypatch.setitem(sys.modules, "pxr", None)
    with pytest.raises(RuntimeError, match="USD"):
        optional_package("pxr", "USD", extra="usd", error=RuntimeError)
